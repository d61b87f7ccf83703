"""A hunt for derivatives that are silently wrong: random scenes, every mode, one plain reference.

What goes wrong goes wrong where a system changes suddenly from one step to the next: stops, brakes, dry
friction, inputs that jump. So that is what `hunting_scenes` makes, with numbers of all orders of magnitude.
Some two hundred cases are slow. More: `pytest -m "slow or exhaustive" tests/test_hunt.py --hunt-seeds 100`.
"""

import pytest
from hunting_modes import examined
from hunting_scenes import TEMPLATES

BY_NAME = {template.name: template for template in TEMPLATES}
EVERY = 20
"""Seeds of each structure."""

FAST = {"slide": 3}
"""Of them in the default suite."""

FOUND = {
    # Contacts: factors carried over them were taken for good; both modes wrong by up to 1e13.
    "slide": [0, 2, 4, 8, 9, 10, 11],
    # A brake, dry friction: forward mode wrong by up to 1e97, reverse by up to 1e2, or not a number.
    # 58: steps whose slow convergence was taken for noise.
    "disc": [2, 3, 4, 5, 7, 9, 10, 11, 58],
}
"""Seeds that failed once."""

UNSOLVED = {("disc", 4)}
"""Cases some of whose steps Newton's iteration leaves 2e-10 from their solution: friction is narrower than
the differences that form the Jacobian, and slow convergence is taken for noise. Differences a tenth as long
solve them, and leave stiffer scenes ("driven", seed 5) 5e-8 from theirs. The derivatives agree."""


def pytest_generate_tests(metafunc):
    seeds = metafunc.config.getoption("--hunt-seeds") or EVERY
    cases = []
    for template in TEMPLATES:
        mark = pytest.mark.exhaustive if template.exhaustive else pytest.mark.slow
        for seed in sorted({*range(seeds), *FOUND.get(template.name, [])}):
            marks = [] if seed < FAST.get(template.name, 0) else [mark]
            if (template.name, seed) in UNSOLVED:
                marks = [*marks, pytest.mark.xfail(reason="steps are not solved to round-off", strict=False)]
            cases.append(pytest.param(template.name, seed, marks=marks))
    metafunc.parametrize(("name", "seed"), cases)


def test_every_mode_gives_the_derivative(name, seed):
    found = examined(BY_NAME[name], seed)
    report = "\n".join(f"  {mode}: {error:.1e} ({most:.0e})" for mode, (error, most) in found.items())
    wrong = [mode for mode, (error, most) in found.items() if not error <= most]
    assert not wrong, f"{name!r}, seed {seed}: {', '.join(wrong)} wrong, of\n{report}"
