"""A hunt for derivatives that are silently wrong: random scenes, every mode, one plain reference.

What goes wrong goes wrong where a system changes suddenly from one step to the next: stops, brakes, dry
friction, inputs that jump. So that is what `hunting_scenes` makes, with numbers of all orders of magnitude.
More seeds: `pytest -m slow tests/test_hunt.py --hunt-seeds 100`.
"""

import pytest
from hunting_modes import examined
from hunting_scenes import TEMPLATES

BY_NAME = {template.name: template for template in TEMPLATES}
EVERY = 9
"""Seeds of each structure in the slow suite."""

FAST = {"slide": 3}
"""Seeds in the default suite."""

FOUND = {
    # Factors carried over a contact, the changes of a state then grew without bounds, in both modes.
    "slide": [0, 2, 4, 7, 11],
    # A brake or dry friction: forward mode by up to 1e67, reverse by up to 1e3.
    "disc": [0, 2, 4, 5, 9, 10],
    # Friction narrower than the differences by which Jacobians are formed: a step that was not solved.
    "arm": [1],
}
"""Seeds that failed once."""


def pytest_generate_tests(metafunc):
    seeds = metafunc.config.getoption("--hunt-seeds") or EVERY
    cases = []
    for template in TEMPLATES:
        for seed in sorted({*range(seeds), *FOUND.get(template.name, [])}):
            marks = [] if seed < FAST.get(template.name, 0) else [pytest.mark.slow]
            cases.append(pytest.param(template.name, seed, marks=marks))
    metafunc.parametrize(("name", "seed"), cases)


def test_every_mode_gives_the_derivative(name, seed):
    found = examined(BY_NAME[name], seed)
    report = "\n".join(f"  {mode}: {error:.1e} ({most:.0e})" for mode, (error, most) in found.items())
    wrong = [mode for mode, (error, most) in found.items() if not error <= most]
    assert not wrong, f"{name!r}, seed {seed}: {', '.join(wrong)} wrong, of\n{report}"
