"""A hunt for derivatives that are silently wrong: random scenes, every mode, one plain reference.

What goes wrong goes wrong where a system changes suddenly from one step to the next: stops, brakes, dry
friction, inputs that jump. So that is what `hunting_scenes` makes, with numbers of all orders of magnitude.
Seeds of one structure share its programs. More: `pytest -m "slow or exhaustive" tests/test_hunt.py
--hunt-seeds 100`; the seed of a case that failed goes on the list `FAILED_ONCE`.
"""

import pytest
from hunting_modes import examined
from hunting_scenes import TEMPLATES

BY_NAME = {template.name: template for template in TEMPLATES}
SEEDS = 20
"""Of each structure."""

FIRST = ("slide", 3)
"""A structure of the default suite, and how many of its seeds."""

FAILED_ONCE = {
    # Contacts: factors carried over them were taken for good; both modes wrong by up to 1e13.
    "slide": [0, 2, 4, 8, 9, 10, 11],
    # A brake, dry friction: forward mode wrong by up to 1e97, reverse by up to 1e2, or not a number.
    # 58: steps whose slow convergence was taken for noise.
    "disc": [2, 3, 4, 5, 7, 9, 10, 11, 58],
}
"""Seeds by structure."""

UNSOLVED = {
    **{"disc": [4], "disc, twice": [4], "flag": [9, 14], "mixed": [0]},
    **{"driven": [5], "driven, with kicks": [5], "driven, fourth order": [5]},
}
"""Seeds some of whose steps Newton's iteration leaves 2e-10 to 2e-8 from their solution: friction is narrower
than the differences that form the Jacobian, and slow convergence is taken for noise. Differences a tenth as
long solve some of them, and leave others farther from theirs."""

LEFT = 2e-4
"""How far their derivatives are from those at the solution."""

JUMPS = ("tumbling", 13, "differences")
"""A case that stands where its motion jumps: the loss has two values, 0.07 apart, which change places with
numbers 1e-9 apart. Differences across the jump say nothing; the derivatives are those of the one value."""


def pytest_generate_tests(metafunc):
    count = metafunc.config.getoption("--hunt-seeds") or SEEDS
    name, few = FIRST
    cases = [pytest.param(name, range(few), id=f"{name}, {few} seeds")]
    for template in TEMPLATES:
        seeds = sorted({*range(count), *FAILED_ONCE.get(template.name, [])})
        mark = pytest.mark.exhaustive if template.exhaustive else pytest.mark.slow
        cases.append(pytest.param(template.name, seeds, marks=mark, id=template.name))
    metafunc.parametrize(("name", "seeds"), cases)


def test_every_mode_gives_the_derivative(name, seeds):
    wrong = []
    for seed in seeds:
        errors, left = examined(BY_NAME[name], seed), LEFT if seed in UNSOLVED.get(name, ()) else 0.0
        wrong += [
            f"seed {seed}, {mode}: {error:.1e} ({most:.0e})"
            for mode, (error, most) in errors.items()
            if not error <= max(most, left) and (name, seed, mode) != JUMPS
        ]
    assert not wrong, f"{name!r} is wrong:\n" + "\n".join(wrong)
