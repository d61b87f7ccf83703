// Plays a packed motion by WebGL 2: meshes that move with frames, surfaces that deform, traces, a ground.
const $ = id => document.getElementById(id), MISSING = -32768;
const sub = (a, b) => a.map((x, i) => x - b[i]), add = (a, b) => a.map((x, i) => x + b[i]);
const scaled = (a, s) => a.map(x => x * s), dot = (a, b) => a.reduce((s, x, i) => s + x * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => scaled(a, 1 / (Math.hypot(...a) || 1));
const times = (a, b) => a.map((_, i) => [0, 1, 2, 3].reduce((s, k) => s + a[4 * k + i % 4] * b[(i & 12) + k], 0));
const ONE = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
async function unpack() {
  const bytes = Uint8Array.from(atob(packed), c => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}
function program(gl) {
  const made = gl.createProgram();
  for (const [kind, id] of [[gl.VERTEX_SHADER, "vertex"], [gl.FRAGMENT_SHADER, "fragment"]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, $(id).textContent.trim()); gl.compileShader(shader); gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
  }
  ["place", "normal", "colour"].forEach((name, k) => gl.bindAttribLocation(made, k, name));
  gl.linkProgram(made); gl.useProgram(made); return made;
}
function start(data) {
  const gl = $("canvas").getContext("webgl2", { antialias: true });
  if (!gl) { $("title").textContent = "This view needs WebGL 2, which this browser does not offer."; return; }
  const made = program(gl), at = {};
  for (const name of ["seen", "model", "eye", "up", "middle", "plain", "mode", "alpha", "cell", "reach"])
    at[name] = gl.getUniformLocation(made, name);

  // Numbers are whole multiples of a step, differences along time where there is one: to be undone once, in place.
  const whole = r => {
    const found = new Int16Array(data, r.at, r.count);
    for (let i = r.stride; i < r.count && r.stride; i++) found[i] += found[i - r.stride];
    return found;
  };
  const floats = r => Float32Array.from(whole(r), x => r.least + r.step * x);
  const buffer = (values, keep) => {
    const b = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, b); gl.bufferData(gl.ARRAY_BUFFER, values, keep ? gl.STATIC_DRAW : gl.DYNAMIC_DRAW);
    return b;
  };
  const meshes = scene.meshes.map(m => {
    const place = floats(m.place);
    return { place: buffer(place, 1), normal: buffer(floats(m.normal), 1), shade: floats(m.shade),
      count: place.length / 3, lines: buffer(floats(m.lines), 1), ends: m.lines.count / 3 };
  });
  for (const s of scene.solids) {
    s.track = whole(s.rows);
    const shade = meshes[s.mesh].shade, colour = new Float32Array(3 * shade.length);
    shade.forEach((x, i) => s.colour.forEach((c, k) => { colour[3 * i + k] = c * x; }));
    s.paint = buffer(colour, 1);
  }
  for (const s of scene.skins) {
    s.track = whole(s.points); s.shown = s.values && whole(s.values);
    s.corners = new Int32Array(data, s.faces.at, s.faces.count);
    s.place = buffer(0); s.paint = buffer(0); s.lines = buffer(0);
  }
  for (const s of scene.traces) s.path = buffer(floats(s.points), 1);
  const plane = buffer(new Float32Array(18)), pictures = scene.times.length;

  const lattice = scene.ground === null ? "" : `   (lattice of ${+scene.cell.toPrecision(3)} m)`;
  // --- what the reader sets
  const state = { now: 0, playing: true, lane: 0, follow: "" }, camera = {}, up = unit(scene.up), middle = scaled(add(...scene.extent), 0.5), end = scene.times[pictures - 1] - scene.times[0];
  const across = unit(cross(Math.abs(up[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], up)), ahead = cross(up, across);
  const home = () => Object.assign(camera, { target: middle, distance: 1.3 * scene.reach, offset: [0, 0, 0],
    turn: Math.atan2(dot(scene.eye, ahead), dot(scene.eye, across)), lift: Math.asin(dot(scene.eye, up)) });
  home(); $("title").textContent = scene.title;
  for (const f of [0.05, 0.1, 0.25, 0.5, 1, 2, 4]) {
    const pace = f * scene.pace;
    $("speed").add(new Option(`${+pace.toPrecision(2)} ×`, pace, f === 1, f === 1));
  }
  for (const name of scene.bodies) $("follow").add(new Option(name, name));
  $("follow").value = state.follow = scene.follow;
  $("lanes").hidden = $("ghostly").hidden = scene.lanes === 1; $("lane").max = scene.lanes - 1;
  $("forceful").hidden = !scene.solids.some(s => s.kind === "force");
  const bodies = scene.solids.filter(s => s.kind === "body");
  const swatches = [...bodies, ...scene.skins.filter(s => !s.values), ...scene.traces];
  const css = c => `rgb(${c.map(x => Math.round(255 * x))})`;
  const line = (parent, kind, text) => Object.assign(parent.appendChild(document.createElement(kind)), { textContent: text });
  for (const s of swatches.slice(0, 12)) {
    const row = line($("legend"), "div", "");
    line(row, "i", "").style.background = css(s.colour); line(row, "span", s.name);
  }
  if (swatches.length > 12) line($("legend"), "div", `and ${swatches.length - 12} more`);
  for (const s of scene.skins.filter(s => s.values)) {
    const box = line($("legend"), "div", `${s.name}: ${s.label}`); box.className = "scale";
    line(box, "div", "").style.background = `linear-gradient(90deg, ${scene.colours.map(css)})`;
    for (const x of s.range) line(box, "span", x.toPrecision(3));
  }
  // --- where things are at a time
  const picture = t => {
    let k = 0, high = pictures - 1;
    while (high - k > 1) { const m = (k + high) >> 1; if (scene.times[m] <= t) k = m; else high = m; }
    const gap = scene.times[high] - scene.times[k];
    return [k, high, gap > 0 ? Math.min(1, Math.max(0, (t - scene.times[k]) / gap)) : 0];
  };
  const between = (track, ref, size, lane, [k, next, part]) => {
    const a = (lane * pictures + k) * size, b = (lane * pictures + next) * size, found = new Float32Array(size);
    // At a time at which something comes or goes, there is nothing to interpolate with.
    const f = track[b] === MISSING ? 0 : track[a] === MISSING ? 1 : part;
    if (track[f === 1 ? b : a] === MISSING || (track[a] === MISSING && part < 1)) return null;
    for (let i = 0; i < size; i++) found[i] = ref.least + ref.step * (track[a + i] * (1 - f) + track[b + i] * f);
    return found;
  };
  const frame = (s, lane, place, r = between(s.track, s.rows, 12, lane, place)) => {
    if (!r) return null;
    let v = [1, 2, 3].map(k => [...r.slice(3 * k, 3 * k + 3)]);
    if (s.rigid) { const a = unit(v[0]), c = unit(cross(a, v[1])); v = [a, cross(c, a), c]; }
    return [...v[0], 0, ...v[1], 0, ...v[2], 0, r[0], r[1], r[2], 1];
  };
  const centre = place => {
    const s = bodies.find(s => s.name === state.follow), m = s && frame(s, state.lane, place);
    if (m) return [0, 1, 2].map(i => m[12 + i] + s.centre.reduce((t, c, k) => t + c * m[4 * k + i], 0));
    const skin = scene.skins.find(s => s.name === state.follow);
    const p = skin && between(skin.track, skin.points, skin.size, state.lane, place);
    return p && [0, 1, 2].map(i => { let t = 0; for (let k = i; k < p.length; k += 3) t += p[k]; return 3 * t / p.length; });
  };
  // --- drawing
  const attribute = (k, b, fallback) => {
    if (!b) { gl.disableVertexAttribArray(k); gl.vertexAttrib3f(k, ...(fallback || [0, 0, 0])); return; }
    gl.bindBuffer(gl.ARRAY_BUFFER, b); gl.enableVertexAttribArray(k); gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 0, 0);
  };
  const plain = (mode, colour) => { gl.uniform1i(at.mode, mode); if (colour) gl.uniform4fv(at.plain, colour); };
  const solid = (s, model, edges, m = meshes[s.mesh]) => {
    gl.uniformMatrix4fv(at.model, false, model);
    attribute(0, m.place); attribute(1, s.rigid && m.normal); attribute(2, s.paint);
    gl.drawArrays(gl.TRIANGLES, 0, m.count);
    if (edges && m.ends && s.kind === "body") {
      plain(1, [...scaled(s.colour, 0.45), 1]); attribute(0, m.lines); gl.drawArrays(gl.LINES, 0, m.ends); plain(0);
    }
  };
  const fill = (b, values) => { gl.bindBuffer(gl.ARRAY_BUFFER, b); gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW); };
  const skin = (s, lane, place) => {
    const p = between(s.track, s.points, s.size, lane, place), faces = s.corners.length / 4;
    if (!p) return false;
    const v = s.shown && between(s.shown, s.values, faces, lane, place);
    const where = new Float32Array(18 * faces), paint = new Float32Array(18 * faces), lines = new Float32Array(24 * faces);
    for (let f = 0; f < faces; f++) {
      const q = s.corners.subarray(4 * f, 4 * f + 4);
      let c = s.colour;
      if (v) {
        const x = Math.max(0, Math.min(1, (v[f] - s.range[0]) / (s.range[1] - s.range[0]))) * (scene.colours.length - 1);
        const k = Math.min(Math.floor(x), scene.colours.length - 2);
        c = scene.colours[k].map((y, i) => y + (x - k) * (scene.colours[k + 1][i] - y));
      }
      [0, 1, 2, 0, 2, 3].forEach((k, n) => { for (let i = 0; i < 3; i++) {
        where[18 * f + 3 * n + i] = p[3 * q[k] + i]; paint[18 * f + 3 * n + i] = c[i]; } });
      [0, 1, 1, 2, 2, 3, 3, 0].forEach((k, n) => { for (let i = 0; i < 3; i++) lines[24 * f + 3 * n + i] = p[3 * q[k] + i]; });
    }
    fill(s.place, where); fill(s.paint, paint); fill(s.lines, lines);
    return 6 * faces;
  };
  const lane = (k, place, alpha, shadow) => {
    gl.uniform1f(at.alpha, alpha);
    for (const s of scene.solids) {
      const m = s.kind === "force" ? null : frame(s, k, place);
      if (m) solid(s, shadow ? times(shadow, m) : m, !shadow && alpha === 1);
    }
    gl.uniformMatrix4fv(at.model, false, shadow || ONE);
    for (const s of scene.skins) {
      const count = skin(s, k, place);
      if (!count) continue;
      attribute(0, s.place); attribute(1); attribute(2, s.paint); gl.drawArrays(gl.TRIANGLES, 0, count);
      if (s.edges && !shadow && alpha === 1) {
        plain(1, [0.12, 0.14, 0.17, 0.5]); attribute(0, s.lines); gl.drawArrays(gl.LINES, 0, count * 4 / 3); plain(0);
      }
    }
  };
  const ground = (place, target) => {
    const flat = sub(target, scaled(up, dot(target, up) - scene.ground)), reach = 4 * scene.reach;
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]];
    const points = corners.flatMap(([a, b]) => add(flat, add(scaled(across, a * reach), scaled(ahead, b * reach))));
    fill(plane, new Float32Array(points));
    gl.uniform3fv(at.middle, flat); gl.uniform1f(at.reach, reach); gl.uniform1f(at.cell, scene.cell);
    gl.uniformMatrix4fv(at.model, false, ONE); attribute(0, plane); plain(2);
    gl.depthMask(false); gl.drawArrays(gl.TRIANGLES, 0, 6); gl.depthMask(true);
    // Shadows: everything along the light onto a plane just above the ground.
    const light = unit(add(up, scaled(ahead, 0.3))), lift = scene.ground + 2e-3 * scene.reach, high = dot(light, up);
    const shadow = ONE.map((x, i) => { const r = i % 4, c = i >> 2;
      return r === 3 ? x : c === 3 ? light[r] * lift / high : x - light[r] * up[c] / high; });
    plain(1, [0.76, 0.78, 0.81, 1]); lane(state.lane, place, 1, shadow);
  };
  const draw = () => {
    const ratio = window.devicePixelRatio || 1, wide = $("canvas").clientWidth * ratio, high = $("canvas").clientHeight * ratio;
    if ($("canvas").width !== wide || $("canvas").height !== high) Object.assign($("canvas"), { width: wide, height: high });
    const place = picture(scene.times[0] + state.now), followed = state.follow && centre(place);
    const target = add(followed || camera.target, followed ? camera.offset : [0, 0, 0]);
    const flat = add(scaled(across, Math.cos(camera.turn)), scaled(ahead, Math.sin(camera.turn)));
    const away = add(scaled(flat, Math.cos(camera.lift)), scaled(up, Math.sin(camera.lift)));
    const distance = camera.distance * Math.max(1, 1.1 * high / wide), eye = add(target, scaled(away, distance));
    const right = unit(cross(up, away)), over = cross(away, right), near = 0.01 * distance, far = 20 * distance + 10 * scene.size;
    const look = [right[0], over[0], away[0], 0, right[1], over[1], away[1], 0, right[2], over[2], away[2], 0,
      -dot(right, eye), -dot(over, eye), -dot(away, eye), 1];
    const f = 1 / Math.tan(0.35), lens = [f * high / wide, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1,
      0, 0, 2 * far * near / (near - far), 0];
    Object.assign(camera, { right, over, span: 2 * distance / f });
    gl.viewport(0, 0, wide, high); gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST); gl.enable(gl.BLEND); gl.enable(gl.POLYGON_OFFSET_FILL); gl.polygonOffset(1, 1);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.uniformMatrix4fv(at.seen, false, times(lens, look)); gl.uniform3fv(at.eye, eye); gl.uniform3fv(at.up, up);
    if (scene.ground !== null) ground(place, followed ? target : middle);
    plain(0); lane(state.lane, place, 1);
    for (const s of scene.traces) {
      gl.uniformMatrix4fv(at.model, false, ONE); plain(1, [...s.colour, 1]); attribute(0, s.path);
      gl.drawArrays(gl.LINE_STRIP, state.lane * pictures, place[0] + 1); plain(0);
    }
    if (scene.lanes > 1 && $("ghosts").checked) {
      gl.depthMask(false);
      for (let k = 0; k < scene.lanes; k++) if (k !== state.lane) lane(k, place, 0.2);
      gl.depthMask(true);
    }
    // Forces are seen through what they act on.
    gl.clear(gl.DEPTH_BUFFER_BIT); gl.uniform1f(at.alpha, 1);
    for (const s of scene.solids.filter(s => s.kind === "force" && $("forces").checked)) {
      const m = frame(s, state.lane, place);
      if (m) solid(s, m);
    }
    $("time").textContent = `t = ${(scene.times[0] + state.now).toFixed(scene.digits)} s` + lattice;
    $("place").value = end > 0 ? state.now / end : 0; $("which").textContent = `${state.lane + 1} of ${scene.lanes}`;
  };
  // --- hands
  const play = on => { state.playing = on; $("play").textContent = on ? "❚❚" : "►"; };
  $("play").onclick = () => play(!state.playing);
  $("place").oninput = e => { play(false); state.now = e.target.value * end; };
  $("follow").onchange = e => { state.follow = e.target.value; camera.offset = [0, 0, 0]; };
  $("lane").oninput = e => { state.lane = +e.target.value; };
  $("home").onclick = $("canvas").ondblclick = home;
  document.onkeydown = e => { if (e.code === "Space") { e.preventDefault(); play(!state.playing); } };
  $("canvas").onpointerdown = e => $("canvas").setPointerCapture(e.pointerId);
  $("canvas").oncontextmenu = e => e.preventDefault();
  $("canvas").onpointermove = e => {
    if (!e.buttons) return;
    if (e.buttons > 1 || e.shiftKey) {
      const s = camera.span / $("canvas").clientHeight;
      const by = add(scaled(camera.right, -e.movementX * s), scaled(camera.over, e.movementY * s));
      if (state.follow) camera.offset = add(camera.offset, by); else camera.target = add(camera.target, by);
    } else {
      camera.turn -= 0.008 * e.movementX;
      camera.lift = Math.max(-1.55, Math.min(1.55, camera.lift + 0.008 * e.movementY));
    }
  };
  $("canvas").onwheel = e => { e.preventDefault(); camera.distance *= Math.exp(0.001 * e.deltaY); };

  // A number behind the name of the file stops there: motion.html#0.5 is the middle.
  const asked = parseFloat(location.hash.slice(1));
  if (asked >= 0) { play(false); state.now = Math.min(asked, 1) * end; }
  let last = null;
  const tick = now => {
    if (state.playing && last !== null) state.now += Math.min(now - last, 100) / 1000 * $("speed").value;
    if (state.now > end) state.now = 0;
    last = now; draw(); requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
}

unpack().then(start).catch(problem => { $("title").textContent = `The view failed: ${problem.message}`; throw problem; });
