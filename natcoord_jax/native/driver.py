"""The function that XLA calls: it deals out the lanes of a batch, in groups, over threads.

Written in LLVM's language, so that no compiler is asked for where it is used. The layout of what XLA hands
over is that of `xla/ffi/api/c_api.h`, whose structures only grow at their ends.
"""

import re
from functools import cache
from pathlib import Path

import jax

FRAME = {"extension": 8, "api": 16, "context": 24, "args": 72, "rets": 112}
"""Bytes at which things are in a call."""

DATA, DIMS = 24, 40
"""Bytes at which the data and the sizes of an array are."""

EXTENSION_TYPE, METADATA, VERSION = 8, 24, 24
"""Bytes at which an extension has its type and the description of a function, and this its version."""

SCHEDULE, THREADS = 136, 144
"""Bytes at which the functions of threads are among all that XLA offers."""

JOB = {"next": 0, "done": 8, "users": 16, "groups": 24, "lanes": 32, "in": 40}
"""Bytes at which things are in what threads share."""


@cache
def version() -> tuple[int, int]:
    """Of the interface, as the version of XLA at hand has it."""
    text = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text()
    major, minor = (re.search(rf"#define XLA_FFI_API_{x} (\d+)", text) for x in ("MAJOR", "MINOR"))
    assert major is not None and minor is not None
    return int(major[1]), int(minor[1])


def driver(lanes: int, inputs: int, outputs: int, work: int, together: bool) -> str:
    """The text of `handler(call)`, which calls `body` for every group of lanes.

    Args:
        lanes: of a group.
        inputs: number of arrays that are read.
        outputs: number of arrays that are written.
        work: bytes that the body needs.
        together: whether arrays have an axis of lanes first; if not, there is one lane.
    """
    major, minor = version()
    return _TEXT % {
        "lanes": lanes,
        "rest": lanes - 1,
        "inputs": inputs,
        "outputs": outputs,
        "work": max(work, 64) + 64,
        "job": JOB["in"] + 8 * (inputs + outputs),
        "out": JOB["in"] + 8 * inputs,
        "count": "load i64, ptr %dims" if together else "add i64 1, 0",
        "major": major,
        "minor": minor,
        "numbers": "\n".join(_number(k) for k in range(lanes)),
        "read": "\n".join(
            [_pointer("args", k, JOB["in"] + 8 * k) for k in range(inputs)]
            + [_pointer("rets", k, JOB["in"] + 8 * (inputs + k)) for k in range(outputs)]
        ),
    }


def _number(k: int) -> str:
    """The number of a lane of a group; there is one of every number in the last group, too."""
    return f"""%n{k} = add i64 %first, {k}
%s{k} = icmp slt i64 %n{k}, %last
%l{k} = select i1 %s{k}, i64 %n{k}, i64 %last
%p{k} = getelementptr i64, ptr %numbers, i64 {k}
store i64 %l{k}, ptr %p{k}"""


def _pointer(kind: str, k: int, place: int) -> str:
    """Where an array is, noted in the job."""
    n = f"{kind}{k}"
    return f"""%{n}.a = getelementptr ptr, ptr %{kind}, i64 {k}
%{n}.b = load ptr, ptr %{n}.a
%{n}.c = getelementptr i8, ptr %{n}.b, i64 {DATA}
%{n}.d = load ptr, ptr %{n}.c
%{n}.e = getelementptr i8, ptr %job, i64 {place}
store ptr %{n}.d, ptr %{n}.e"""


_TEXT = f"""
declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @sched_yield()
@threads = global i64 0

define internal void @groups(ptr %%job) {{
entry:
%%numbers = alloca [%(lanes)d x i64]
%%raw = call ptr @malloc(i64 %(work)d)
%%address = ptrtoint ptr %%raw to i64
%%up = add i64 %%address, 63
%%even = and i64 %%up, -64
%%work = inttoptr i64 %%even to ptr
%%count.a = getelementptr i8, ptr %%job, i64 {JOB["groups"]}
%%count = load i64, ptr %%count.a
%%lanes.a = getelementptr i8, ptr %%job, i64 {JOB["lanes"]}
%%lanes = load i64, ptr %%lanes.a
%%last = sub i64 %%lanes, 1
%%in = getelementptr i8, ptr %%job, i64 {JOB["in"]}
%%out = getelementptr i8, ptr %%job, i64 %(out)d
br label %%next
next:
%%next.a = getelementptr i8, ptr %%job, i64 {JOB["next"]}
%%group = atomicrmw add ptr %%next.a, i64 1 seq_cst
%%more = icmp slt i64 %%group, %%count
br i1 %%more, label %%one, label %%end
one:
%%first = mul i64 %%group, %(lanes)d
%(numbers)s
call void @body(ptr %%in, ptr %%out, ptr %%work, ptr %%numbers)
%%done.a = getelementptr i8, ptr %%job, i64 {JOB["done"]}
%%done = atomicrmw add ptr %%done.a, i64 1 seq_cst
br label %%next
end:
call void @free(ptr %%raw)
ret void
}}

define internal void @leave(ptr %%job) {{
%%users.a = getelementptr i8, ptr %%job, i64 {JOB["users"]}
%%users = atomicrmw sub ptr %%users.a, i64 1 seq_cst
%%last = icmp eq i64 %%users, 1
br i1 %%last, label %%gone, label %%end
gone:
call void @free(ptr %%job)
br label %%end
end:
ret void
}}

define internal void @task(ptr %%job) {{
call void @groups(ptr %%job)
call void @leave(ptr %%job)
ret void
}}

define i64 @pool(ptr %%frame) {{
%%limit = load i64, ptr @threads
%%one = icmp eq i64 %%limit, 1
br i1 %%one, label %%alone, label %%ask
alone:
ret i64 1
ask:
%%found = alloca i64
store i64 1, ptr %%found
%%args = alloca [4 x i64]
store [4 x i64] [i64 32, i64 0, i64 0, i64 0], ptr %%args
%%context.a = getelementptr i8, ptr %%frame, i64 {FRAME["context"]}
%%context = load ptr, ptr %%context.a
%%context.b = getelementptr i8, ptr %%args, i64 16
store ptr %%context, ptr %%context.b
%%found.b = getelementptr i8, ptr %%args, i64 24
store ptr %%found, ptr %%found.b
%%api.a = getelementptr i8, ptr %%frame, i64 {FRAME["api"]}
%%api = load ptr, ptr %%api.a
%%function.a = getelementptr i8, ptr %%api, i64 {THREADS}
%%function = load ptr, ptr %%function.a
%%error = call ptr %%function(ptr %%args)
%%n = load i64, ptr %%found
%%limited = icmp sgt i64 %%limit, 1
%%less = icmp slt i64 %%limit, %%n
%%both = and i1 %%limited, %%less
%%number = select i1 %%both, i64 %%limit, i64 %%n
ret i64 %%number
}}

define internal void @spread(ptr %%frame, ptr %%job, i64 %%groups) {{
entry:
%%alone = icmp sle i64 %%groups, 1
br i1 %%alone, label %%end, label %%ask
ask:
%%pool = call i64 @pool(ptr %%frame)
%%less = icmp slt i64 %%groups, %%pool
%%workers = select i1 %%less, i64 %%groups, i64 %%pool
%%args = alloca [5 x i64]
store [5 x i64] [i64 40, i64 0, i64 0, i64 0, i64 0], ptr %%args
%%context.a = getelementptr i8, ptr %%frame, i64 {FRAME["context"]}
%%context = load ptr, ptr %%context.a
%%context.b = getelementptr i8, ptr %%args, i64 16
store ptr %%context, ptr %%context.b
%%task.b = getelementptr i8, ptr %%args, i64 24
store ptr @task, ptr %%task.b
%%job.b = getelementptr i8, ptr %%args, i64 32
store ptr %%job, ptr %%job.b
%%api.a = getelementptr i8, ptr %%frame, i64 {FRAME["api"]}
%%api = load ptr, ptr %%api.a
%%function.a = getelementptr i8, ptr %%api, i64 {SCHEDULE}
%%function = load ptr, ptr %%function.a
%%users.a = getelementptr i8, ptr %%job, i64 {JOB["users"]}
br label %%head
head:
%%k = phi i64 [1, %%ask], [%%k.next, %%sent]
%%more = icmp slt i64 %%k, %%workers
br i1 %%more, label %%send, label %%end
send:
%%users = atomicrmw add ptr %%users.a, i64 1 seq_cst
%%error = call ptr %%function(ptr %%args)
%%failed = icmp ne ptr %%error, null
br i1 %%failed, label %%back, label %%sent
back:
%%less.users = atomicrmw sub ptr %%users.a, i64 1 seq_cst
br label %%sent
sent:
%%k.next = add i64 %%k, 1
br label %%head
end:
ret void
}}

define internal void @execute(ptr %%frame) {{
entry:
%%args.a = getelementptr i8, ptr %%frame, i64 {FRAME["args"]}
%%args = load ptr, ptr %%args.a
%%rets.a = getelementptr i8, ptr %%frame, i64 {FRAME["rets"]}
%%rets = load ptr, ptr %%rets.a
%%job = call ptr @malloc(i64 %(job)d)
%(read)s
%%dims.a = getelementptr i8, ptr %%rets0.b, i64 {DIMS}
%%dims = load ptr, ptr %%dims.a
%%lanes = %(count)s
%%more = add i64 %%lanes, %(rest)d
%%groups = sdiv i64 %%more, %(lanes)d
%%next = getelementptr i8, ptr %%job, i64 {JOB["next"]}
store i64 0, ptr %%next
%%done = getelementptr i8, ptr %%job, i64 {JOB["done"]}
store i64 0, ptr %%done
%%users = getelementptr i8, ptr %%job, i64 {JOB["users"]}
store i64 1, ptr %%users
%%groups.a = getelementptr i8, ptr %%job, i64 {JOB["groups"]}
store i64 %%groups, ptr %%groups.a
%%lanes.a = getelementptr i8, ptr %%job, i64 {JOB["lanes"]}
store i64 %%lanes, ptr %%lanes.a
call void @spread(ptr %%frame, ptr %%job, i64 %%groups)
call void @groups(ptr %%job)
br label %%wait
wait:
%%so.far = load atomic i64, ptr %%done seq_cst, align 8
%%all = icmp sge i64 %%so.far, %%groups
br i1 %%all, label %%end, label %%still
still:
%%yielded = call i32 @sched_yield()
br label %%wait
end:
call void @leave(ptr %%job)
ret void
}}

define ptr @handler(ptr %%frame) {{
entry:
%%extension.a = getelementptr i8, ptr %%frame, i64 {FRAME["extension"]}
%%extension = load ptr, ptr %%extension.a
%%none = icmp eq ptr %%extension, null
br i1 %%none, label %%run, label %%look
look:
%%type.a = getelementptr i8, ptr %%extension, i64 {EXTENSION_TYPE}
%%type = load i32, ptr %%type.a
%%about = icmp eq i32 %%type, 1
br i1 %%about, label %%describe, label %%run
describe:
%%metadata.a = getelementptr i8, ptr %%extension, i64 {METADATA}
%%metadata = load ptr, ptr %%metadata.a
%%major.a = getelementptr i8, ptr %%metadata, i64 {VERSION}
store i32 %(major)d, ptr %%major.a
%%minor.a = getelementptr i8, ptr %%metadata, i64 {VERSION + 4}
store i32 %(minor)d, ptr %%minor.a
ret ptr null
run:
call void @execute(ptr %%frame)
ret ptr null
}}
"""
