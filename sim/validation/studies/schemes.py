"""Implicit integration schemes compared on a reduced example in NumPy, and on scenes where the core supports it.

In the example a ball (x, z, angle) is thrown on a plane with penalty contact, Hunt-Crossley damping and viscous
friction, and bounces until it rolls. All schemes solve systems of the form

    Y = base + γ h F(Y),

like a step of the core, so that costs are comparable: the number of Newton iterations of all stages.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gelflow.sim.simulator import Simulator
from gelflow.sim.validation.gradient_check import difference, retract
from gelflow.sim.validation.reference_motions import ReferenceMotion

Array = NDArray[np.float64]

MASS, RADIUS, GRAVITY = 0.2, 0.03, 9.8
INERTIA = 0.4 * MASS * RADIUS**2
KN, KD, KT, MU = 2e3, 1e3, 5.0, 0.3
START = np.array([0.0, RADIUS + 2e-3, 0.0, 0.5, -0.3, 0.0])  # x, z, angle and their rates
DURATION = 0.32  # [s]
LONGEST = 1e-2  # [s]
BALL_HALVINGS, REFERENCE_HALVINGS = 8, 12


@dataclass(frozen=True)
class Scheme:
    """Errors and costs of one scheme over the step."""

    name: str
    steps: list[float]  # [s]
    errors: list[float]  # relative
    solves: list[int]  # Newton iterations, each with one linear solve, over the whole run

    def slope(self, last: int = 5) -> float:
        """Order of convergence over the finest `last` halvings."""
        return float(np.polyfit(np.log(self.steps[-last - 1 :]), np.log(self.errors[-last - 1 :]), 1)[0])

    def cost_of(self, error: float) -> float | None:
        """Iterations beyond which the error stays below `error`, interpolated; None if it does not."""
        below = np.array(self.errors) <= error
        if not below[-1]:
            return None
        first = len(below) - int(np.argmin(below[::-1])) if not below.all() else 0
        if first == 0:
            return float(self.solves[0])
        e, c = np.log(self.errors[first - 1 : first + 1]), np.log(self.solves[first - 1 : first + 1])
        return float(np.exp(c[0] + (c[1] - c[0]) * (np.log(error) - e[0]) / (e[1] - e[0])))


def force(y: Array) -> tuple[Array, Array]:
    """F(y), shape (6,), and ∂F/∂y: gravity, and the core's contact law at the lowest point of the ball."""
    f, by = np.zeros(6), np.zeros((6, 6))
    f[:3] = y[3:]
    by[:3, 3:] = np.eye(3)
    f[4] = -GRAVITY
    depth, rate = RADIUS - y[1], y[4]
    stiffness = KN - KD * rate
    if depth <= 0 or stiffness <= 0:
        return f, by
    normal = stiffness * depth
    normal_by = np.array([0, -stiffness, 0, 0, -KD * depth, 0])
    slip = y[3] + RADIUS * y[5]
    wanted, limit = -KT * slip, MU * normal
    if abs(wanted) <= limit:
        friction, friction_by = wanted, np.array([0, 0, 0, -KT, 0, -KT * RADIUS])
    else:
        friction, friction_by = np.sign(wanted) * limit, np.sign(wanted) * MU * normal_by
    f[3:] += friction / MASS, normal / MASS, RADIUS * friction / INERTIA
    by[3:] += np.outer([1 / MASS, 0, RADIUS / INERTIA], friction_by) + np.outer([0, 1 / MASS, 0], normal_by)
    return f, by


class NewtonSolver:
    """Solves Y = base + h F(Y) by Newton's method and counts the iterations."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, base: Array, h: float, guess: Array) -> Array:
        y = guess.copy()
        for _ in range(100):
            f, by = force(y)
            residual = y - base - h * f
            if np.abs(residual).max() <= 1e-13:
                return y
            y = y - np.linalg.solve(np.eye(6) - h * by, residual)
            self.count += 1
        return y  # alternates between the sides of a kink, with negligible difference


Stepper = Callable[[NewtonSolver, Array, Array | None, float], Array]  # (solver, y, previous y, h) → next y


def bdf1(solve: NewtonSolver, y: Array, _: Array | None, h: float) -> Array:
    return solve(y, h, y)


def bdf2(solve: NewtonSolver, y: Array, before: Array | None, h: float) -> Array:
    return solve(y, h, y) if before is None else solve((4 * y - before) / 3, 2 / 3 * h, y)


def extrapolated(solve: NewtonSolver, y: Array, _: Array | None, h: float) -> Array:
    """Richardson extrapolation of BDF1, twice two half steps minus one whole step: second order."""
    half = solve(y, h / 2, y)
    return 2 * solve(half, h / 2, half) - solve(y, h, y)


def sdirk2(solve: NewtonSolver, y: Array, _: Array | None, h: float) -> Array:
    """SDIRK method of Alexander with two stages, γ = 1 − 1/√2: second order, L-stable."""
    gamma = 1 - np.sqrt(0.5)
    first = solve(y, gamma * h, y)
    slope = (first - y) / (gamma * h)
    return solve(y + (1 - gamma) * h * slope, gamma * h, first)


def trbdf2(solve: NewtonSolver, y: Array, _: Array | None, h: float) -> Array:
    """Trapezoidal rule up to (2 − √2) h, then BDF2: second order, L-stable."""
    gamma = 2 - np.sqrt(2)
    middle = solve(y + gamma * h / 2 * force(y)[0], gamma * h / 2, y)
    base = (middle / gamma - (1 - gamma) ** 2 / gamma * y) / (2 - gamma)
    return solve(base, (1 - gamma) / (2 - gamma) * h, middle)


def sdirk3(solve: NewtonSolver, y: Array, _: Array | None, h: float) -> Array:
    """SDIRK method of Alexander with three stages: third order for smooth systems, L-stable."""
    g = 0.4358665215084590
    b1, b2 = -(6 * g * g - 16 * g + 1) / 4, (6 * g * g - 20 * g + 5) / 4
    first = solve(y, g * h, y)
    k1 = (first - y) / (g * h)
    base = y + h * (1 - g) / 2 * k1
    second = solve(base, g * h, first)
    k2 = (second - base) / (g * h)
    return solve(y + h * (b1 * k1 + b2 * k2), g * h, second)


STEPPERS: dict[str, Stepper] = {
    "BDF1": bdf1,
    "BDF2": bdf2,
    "BDF1 extrapolated": extrapolated,
    "SDIRK2": sdirk2,
    "TR-BDF2": trbdf2,
    "SDIRK3": sdirk3,
}


def throw(stepper: Stepper, halvings: int) -> tuple[Array, int]:
    """Final state of the ball, (6,), and number of Newton iterations."""
    solve, h = NewtonSolver(), LONGEST / 2**halvings
    y, before = START, None
    for _ in range(round(DURATION / h)):
        y, before = stepper(solve, y, before, h), y
    return y, solve.count


def ball_errors(done: Callable[[float], None]) -> list[Scheme]:
    """All schemes on the ball: errors of position and angle relative to the displacement."""
    reference, _ = throw(trbdf2, REFERENCE_HALVINGS)
    done(0.5)
    size = float(np.linalg.norm(reference[:3] - START[:3]))
    result = []
    for name, stepper in STEPPERS.items():
        ends = [throw(stepper, k) for k in range(BALL_HALVINGS + 1)]
        errors = [float(np.linalg.norm(y[:3] - reference[:3])) / size for y, _ in ends]
        steps = [LONGEST / 2**k for k in range(BALL_HALVINGS + 1)]
        result.append(Scheme(name, steps, errors, [count for _, count in ends]))
        done(0.5 / len(STEPPERS))
    return result


def extrapolated_scene(whole: Simulator, halves: Simulator, moves: ReferenceMotion) -> tuple[Array, int]:
    """A scene's motion with BDF1 extrapolated in every step: final q (nq,) and Newton iterations.

    `whole` has steps of h, `halves` of h / 2, both BDF1. Anchors are those of the half steps. Raises SimulationError
    when a step fails.
    """
    model = whole.model
    u = moves.step_controls(whole.model.step)
    middles = moves.controls(whole.model.step * (np.arange(len(u)) + 0.5))
    halves.q[0] = moves.q0
    for middle, end in zip(middles, u, strict=True):
        for name in ("q", "v", "anchors", "anchored"):
            getattr(whole, name)[:] = getattr(halves, name)
        whole.step(end)
        halves.step(middle)
        halves.step(end)
        halves.q[0] = retract(model, halves.q[0], difference(model, halves.q[0], whole.q[0]))
        halves.v[:] = 2 * halves.v - whole.v
    whole.check()
    halves.check()
    return halves.q[0].copy(), int(whole.iterations[0] + halves.iterations[0])
