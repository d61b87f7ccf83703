"""Every tolerance of the physics tests, named and reasoned in one place.

Conservation is tested against round-off, accuracy against the digits of a reference, derivatives against
what differences can show. A test never has a tolerance of its own.
"""

# Conservation over 1000 steps, relative to the scales of `accounts.scales`. Newton stops at the floor of
# round-off, so that errors of steps add like a random walk: 1e-15 sqrt(1000) is 3e-14. The bounds leave room
# for stiff springs, loops and the cancellation in differences of energies, none for a systematic error: one
# that is left by a step of size h is at least h^3, above 1e-6 here.
ENERGY = 1e-10
MOMENTUM = 1e-11
ANGULAR_MOMENTUM = 1e-11
CONSTRAINT = 1e-11  # [m] and [-], absolute: all scenes are of the size of a metre

# Free spacecraft over 20 000 steps: no springs, no loops; increments keep errors far below 1e-12.
LONG_ENERGY = 1e-12
LONG_DIRECTORS = 1e-13

# One step: balances of single steps, exact up to a few roundings of the largest term.
STEP_BALANCE = 1e-12

# One step from the same state, solved with what the steps before have left and without: the last correction.
STEP_ON_ITS_OWN = 1e-14  # found: 9e-16
# ... of stiff springs, which feel how their ends are rounded.
STIFF_STEP_ON_ITS_OWN = 1e-12

# Identities that hold exactly in exact arithmetic and take a handful of operations: G(q_mid) P = 0 at a
# random step of one radian, frame indifference, third differences of a quadratic.
IDENTITY = 1e-13
INDIFFERENCE = 1e-12

# Two forms of the same equations (tree, loop, multipliers for all joints), solved to the floor of round-off,
# after 100 steps of a motion that is not chaotic.
SAME_TRAJECTORY = 1e-10
# Parallel bars of a row that passes its flat position, times the distance from there: at most 2e-13 was found
# in ten seconds, with steps from 5 to 25 ms.
ALONG_THE_ROW = 1e-11

# Automatic against exact derivatives: the implicit rule solves a linear system, conditioned like the step.
EXACT_GRADIENT = 1e-9
# Automatic derivatives against each other (modes, batches): the same numbers in another order.
SAME_GRADIENT = 1e-9
# Central differences with steps 10^-1 ... 10^-9: truncation falls with the square of the step until round-off
# grows with its inverse; at the best step an O(1) derivative of a smooth function agrees to about eps^(2/3).
DIFFERENCE_BEST = 1e-7
# ... and on the falling branch a step ten times smaller must be at least this much better (100 in the limit).
DIFFERENCE_FALL = 20.0

# Exact Jacobians of elements that move by rounding, against formulas that leave out what is missing to the
# energy along a step: rounding of it, beside what is left of it.
HARDLY_MOVED = 1e-3

# Observed order of the energy-momentum step.
ORDER = 2.0
ORDER_TOLERANCE = 0.1

# Schemes of order four to ten: the observed order, relatively; errors near round-off spoil the highest.
HIGH_ORDER_TOLERANCE = 0.16
# ... and constraint velocities, absolute [m/s, 1/s], of motions at some ten of those.
TANGENT = 1e-10

# What changes its sign in every step, of rates and velocities that are read, in terms of the largest of them;
# found: up to 1e-4, the motion itself. What is across the constraints as it is: 1e-2, up to all of it.
ALTERNATION = 1e-3

# A hundred steps of three bodies without stiff parts, at any order and with forces of every kind: some ten
# roundings of the terms, 2e-15 to 5e-15.
ENERGY_OF_A_SMALL_SCENE = 1e-13
MOMENTUM_OF_A_SMALL_SCENE = 1e-13
CONSTRAINT_OF_A_SMALL_SCENE = 1e-13
TANGENT_OF_A_SMALL_SCENE = 1e-13

# Work of torques is 200 N m; with (61) angular momentum stays at round-off of the integral of the torques.
SPACECRAFT_MOMENTUM = 1e-9 * 3000.0  # [N m s]

# Against exact solutions, by Richardson's formula from two steps: what the fourth order leaves.
EXACT_SOLUTION = 1e-6
# Rates of order two at the ends of steps miss those of a drive by the square of the angle a step, here 0.03.
CONSTANT_SPEED = 1e-3
# Positions made by another scheme of order two at the same step differ by the square of the step.
OTHER_SCHEME = 5e-5

# --- hard cases (tests/stability) ---------------------------------------------------------------------------

# Steps far too long for a linkage that passes singular positions, over a run, in terms of the energy.
FAR_TOO_LONG_ENERGY = 1e-9  # found: 3e-11

# A million steps. What rounding leaves of a balance is made up for in the next step, so that the energy does
# not walk as 1e-16 sqrt(10^6), and there is nothing steady at orders two and four. Kicks pass through a
# factorisation: for the free body at order six some parts are steady, a fortieth of a rounding a step.
# Relative errors a step by scene, order and quantity.
HANDED_ON = 4e-15  # energy over 4000 steps, root mean square; 1e-14 if every step begins anew
MILLION_STEPS = 1e-10
MILLION_STEPS_ENERGY = {2: 2e-13, 4: 5e-12, 6: 6e-12}  # found: 5e-14, 1.5e-12, 2.5e-12
MILLION_STEPS_CONSTRAINT = 1e-12
STEADY_PARTS = {
    # By processor and compiler: next to none, or steady on others.
    ("dzhanibekov", 4, "energy"): 2e-18,  # found: 9.0e-19
    ("dzhanibekov", 4, "spin"): 1e-18,  # 4.3e-19
    ("dzhanibekov", 6, "energy"): 4e-18,  # found: -2.5e-18
    ("dzhanibekov", 6, "spin"): 2e-18,  # -1.4e-18
}
LONG_STEPS = 5e-17  # found: 1.5e-17 and less; 5e-16 and 9e-16 with rounded coefficients
# Standard errors of a slope; of a thousand walks without drift, whose scatter is taken from 25 blocks, one
# scores higher than this.
SCORE = 4.0
# Steps down to 1e-9 of the period: increments keep round-off what it is at any step; corrections of Newton
# are few, since a guess from the past is good to round-off.
TINY_STEP = 1e-12
TINY_STEP_ITERATIONS = 12


def short_time(duration: float) -> float:
    """Of a gain in velocity by the acceleration at the start: the curvature of the motion, and rounding."""
    return 20.0 * duration + 1e-14 / duration


# The same motion seen in other axes, places [m] and speeds [m/s] of some ten: roundings of 200 steps, 3e-13.
OTHER_AXES = 1e-12
# Bricard's mechanism at steps of 0.01 s against a reference of eight digits.
ERRORS_OF_BRICARD = {2: 1e-4, 4: 1e-6, 6: 1e-6}
# Formulas of the fast top leave out the square of precession over spin, 2e-7; means over a few nutations
# leave their phase.
FAST_TOP = 2e-3
# Rates and multipliers times h: the matrix of a step is, up to this, the one in the limit h = 0.
CONDITION = 1e6
FLAT = 0.05

# --- the hunt (test_hunt.py) --------------------------------------------------------------------------------

# Modes of differentiation against the plain reference, in terms of the largest term of the derivative of the
# loss by the saved states; along directions that change next to nothing, of a part of the largest along any.
SAME_DERIVATIVE = 1e-9
SMALL_PART = 1e-4
# Central differences, in the same terms. Motions with stops, friction and latches have large second and third
# derivatives, so that steps have to be short and rounding counts; mostly found: 1e-8 and less. What scatters
# by more is judged by its scatter, as far as three neighbouring steps agree at all.
DIFFERENCE_OF_A_SUDDEN_MOTION = 1e-6
SPREAD_OF_DIFFERENCES = 1e-3
# Solutions of a step's equations against Newton's iteration with their whole Jacobian, relative to 1 + |x|.
SAME_SOLUTION = 1e-10

# What moves by rounding alone: places of a metre and less, over a few dozen steps. A rod of 50 elements is
# bent by how its places are rounded, 2e-14; others: 1e-15.
AT_REST = 1e-13
# The same about an equilibrium, which is found to this part of its extent.
EQUILIBRIUM = 1e-9

# Second differences of an energy over 1e-4 of its invariants, for the size of what is rounded.
STIFFNESS_BY_ENERGIES = 1e-3

# --- scenes as they were (see test_golden) ----------------------------------------------------------------
GOLDEN_STATE = 1e-12
GOLDEN_GRADIENT = 1e-9
# Newton iterations at other compiler flags than those of the file: rounding decides whether a step makes its
# last one; found: 43 beside 48, 46 beside 49, 78 beside 76, and mostly the same.
GOLDEN_ITERATIONS = 1 / 8

# Blocks of some elements over 1000 steps that strain them by tens of per cent; found: 4e-14 and 2e-14.
ENERGY_OF_A_SOLID = 1e-11
MOMENTUM_OF_A_SOLID = 1e-12

# Cook's membrane, as independent codes and prototypes give it on the same mesh to three or four digits [mm].
COOK = 6e-3

# Thick cylinders and spheres, four elements through the wall, under pressure that widens the hole by a tenth
# and more, by the order of the elements [m]; found: up to 1e-2, and 2e-5.
THICK_WALL = {2.0: 2e-2, 3.0: 1e-4}
# Tip of a falling beam, beside a prototype with the same masses: given to four digits [m].
FALLING_BEAM = 1e-4
# Angular momentum that a pulse gives a soft block of four elements, with lumped and with consistent masses.
L_SHAPE = 1e-2

# --- contact ----------------------------------------------------------------------------------------------

# Hard contacts with several gaps, by the compliance with which they share a load: of the speed of a step [m].
SHARED_GAP = 1e-9
# Contacts so stiff that places are rounded by more of the energy.
ENERGY_OF_A_STIFF_CONTACT = 10 * ENERGY_OF_A_SMALL_SCENE

# --- flexible parts (tests/flexible) ------------------------------------------------------------------------

# What is exact in exact arithmetic, relative to its size: some hundred roundings.
SOME_ROUNDINGS = 1e-13
# What theory of first order says, for loads that turn a section by some 1e-4 radians.
FIRST_ORDER = 1e-6
# Equilibria that are exact for any mesh, in strains and places of one: residuals of stiff stretch, rounded.
EXACT_STATICS = 1e-12
# Figures of statics that are printed to four digits behind the point, of places of some metres [m].
FOUR_DIGITS = 1e-4
THREE_DIGITS = 2e-3
# An L of plates beside beam theory, less what eight elements a leg miss.
FRAME_OF_PLATES = 1.3e-3
