"""Accuracy of the slip estimate on objects that are pulled over a gel, hold, move back, or lose their grip."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gelflow.gel.gel_file import ElasticGel
from gelflow.observation import Grid
from gelflow.perception.force.estimator import ForceEstimator
from gelflow.perception.force.slip import SlipEstimate, SlipEstimator
from gelflow.perception.synthetic.accurate_renderer import AccurateGelRenderer
from gelflow.perception.synthetic.appearance import DegradedGelAppearance, make_appearance
from gelflow.perception.synthetic.image_layers import Contact
from gelflow.perception.synthetic.slipping_layer import (
    INDENTERS,
    Indenter,
    ObjectMotion,
    RigidObject,
    SlippingGel,
    SlippingLayer,
)
from gelflow.perception.tracker import MarkerTracker

Array = NDArray[np.float64]
LoadHistory = Literal["pull", "hold", "release"]
LOAD_HISTORIES: tuple[LoadHistory, ...] = get_args(LoadHistory)

_SIZES = {  # lower and upper limit of size and radius [mm]
    "ball": ((0.0, 0.0), (5.0, 15.0)),
    "rounded disc": ((1.0, 2.2), (1.0, 4.0)),
    "cylinder": ((2.0, 4.0), (3.0, 8.0)),
    "ellipsoid": ((0.0, 0.0), (4.0, 8.0)),
    "ring": ((2.0, 3.0), (2.0, 4.0)),
    "edge": ((2.5, 4.5), (0.8, 1.2)),
    "rounded square": ((1.2, 2.2), (1.0, 4.0)),
}
_PRESS, _HOLD, _BACK = 0.25, 0.15, 0.15  # durations [s]
_RELEASE = 0.7  # time in which the normal force would vanish [s]
_SLIDE = 0.15  # of gross slip at the end [s]
_LONGEST = 3.0  # [s]
_ACCELERATION = 1000.0  # of an object that gravity pulls out of a grip [mm/s²]
_LARGEST_FRICTION = 3.0  # force relative to Young's modulus times pitch [mm]; displacements stay below 0.8 pitches
_STICKS = 0.1  # a gross slip that is stated while more than this sticks is a false alarm


@dataclass(frozen=True)
class SlippingContact:
    """A random contact."""

    shape: RigidObject
    history: LoadHistory
    friction: float
    center: tuple[float, float]  # on the pad [mm]
    normal: float  # [N]
    velocity: tuple[float, float]  # [mm/s]
    turn: float  # [rad/s]
    limit: float  # shear / (friction · normal) at which hold and release begin


def random_contact(
    indenter: Indenter, history: LoadHistory, gel: ElasticGel, grid: Grid, rng: np.random.Generator
) -> SlippingContact:
    """A random contact in the middle half of the grid."""
    size, radius = _SIZES[indenter]
    center = rng.uniform(-0.25, 0.25, 2) * grid.pitch * np.array([grid.rows, grid.cols]) + grid.center
    friction = float(rng.uniform(0.3, 0.9))
    strongest = gel.youngs_modulus * 1e-6 * grid.pitch * _LARGEST_FRICTION
    direction, speed = rng.uniform(0, 2 * np.pi), float(np.exp(rng.uniform(np.log(3), np.log(25))))
    turns = rng.uniform() < 0.3
    return SlippingContact(
        shape=RigidObject(
            indenter, float(rng.uniform(*size)), float(rng.uniform(*radius)), float(rng.uniform(0, np.pi))
        ),
        history=history,
        friction=friction,
        center=(float(center[0]), float(center[1])),
        normal=min(float(np.exp(rng.uniform(np.log(0.7), np.log(4.0)))) * strongest, strongest / friction),
        velocity=(speed * float(np.cos(direction)), speed * float(np.sin(direction))),
        turn=float(rng.choice([-1, 1]) * rng.uniform(0.1, 0.5) * speed / 2.5) if turns else 0.0,
        limit=float(rng.uniform(0.3, 0.93)),
    )


def contact_states(contact: SlippingContact, gel: ElasticGel, grid: Grid, rate: float) -> Iterator[SlippingGel]:
    """The gel at each image, at the rate of the images [Hz]: pressed, moved, then pulled, held or released."""
    start = ObjectMotion(contact.center, 0.0, 0.0)
    layer = SlippingLayer(gel, grid, contact.friction, contact.shape, start)
    velocity, moved, turned = np.array(contact.velocity), np.zeros(2), 0.0
    along = velocity / np.linalg.norm(velocity)
    phase, since, slid, fall, normal = "press", 0, 0, 0.0, 0.0
    for _ in range(round(_LONGEST * rate)):
        since += 1
        if phase == "press":
            normal = contact.normal * since / round(_PRESS * rate)
        elif phase in ("move", "back"):
            sign = 1 if phase == "move" else -1
            moved, turned = moved + sign * velocity / rate, turned + sign * contact.turn / rate
        elif phase == "release":
            normal = max(normal - contact.normal / (_RELEASE * rate), 0.08 * contact.normal)
            fall += _ACCELERATION / rate if slid else 0.0
            moved = moved + along * fall / rate
        x, y = contact.center + moved
        state = layer.step(ObjectMotion((float(x), float(y)), turned, normal))
        yield state
        slid += int(state.gross and phase != "press")
        if slid > _SLIDE * rate:
            return
        load = float(np.linalg.norm(state.shear)) / (contact.friction * state.normal)
        duration = {"press": _PRESS, "hold": _HOLD, "back": _BACK}.get(phase, np.inf)
        if phase == "move" and contact.history != "pull" and (load > contact.limit or state.gross):
            phase, since = "hold", 0
        elif since >= round(min(duration, _LONGEST) * rate):
            if phase == "back":
                return
            after_hold = "back" if contact.history == "hold" else "release"
            phase, since = {"press": "move", "hold": after_hold}[phase], 0


@dataclass(frozen=True)
class SlipErrors:
    """Errors over the images of several contacts."""

    share: Array  # (true share that sticks, estimate, deviation) of images after the object is pressed, (images, 3)
    delays: Array  # from the first image in gross slip to the alarm [s]; inf where there is none, (slips,)
    alarms: Array  # of images without gross slip: whether it was stated while (anything, over 10 %) sticks, (images, 2)
    friction: Array  # estimate / truth at the end of each contact; NaN while not known, (contacts,)
    seconds: Array  # of each estimate, (images,)

    def share_within(self, bound: float) -> float:
        """Share of the images whose error is at most `bound`."""
        return float(np.mean(np.abs(self.share[:, 1] - self.share[:, 0]) <= bound))


def measure_slip(
    indenter: Indenter,
    contacts: int,
    gel: ElasticGel,
    *,
    image_class: str = "typical",
    width: int = 640,
    rate: float = 60.0,
    friction_known: bool = True,
    friction_error: float = 0.0,
    seed: int = 0,
) -> SlipErrors:
    """Move `contacts` random objects over gels with 130 markers, render, track and estimate.

    The friction coefficient is stated with the relative `friction_error`, or not at all. `rate` is that of the images
    [Hz], `width` theirs [px], 4 : 3.
    """
    share: list[tuple[float, float, float]] = []
    delays: list[float] = []
    alarms: list[tuple[bool, bool]] = []
    friction: list[float] = []
    seconds: list[float] = []
    for number in range(contacts):
        rng = np.random.default_rng((INDENTERS.index(indenter), number, seed))
        look = make_appearance(image_class, width=width, height=3 * width // 4, seed=1000 * seed + number, occluders=0)
        contact = random_contact(indenter, LOAD_HISTORIES[number % len(LOAD_HISTORIES)], gel, look.grid, rng)
        stated = contact.friction * (1 + friction_error) if friction_known else None
        estimator = SlipEstimator(look.grid, friction=stated, friction_deviation=abs(friction_error))
        states = list(contact_states(contact, gel, look.grid, rate))
        slips = _estimates(states, look, gel, estimator, rate, seconds)
        known = [(true, slip) for true, slip in zip(states, slips, strict=True) if slip is not None]
        share += [
            (true.stick_share, slip.stick_share, slip.stick_share_deviation or 0.0)
            for true, slip in known[round(_PRESS * rate) :]
            if slip.stick_share is not None
        ]
        alarms += [(slip.gross, slip.gross and true.stick_share > _STICKS) for true, slip in known if not true.gross]
        delays += _delays(states, slips, rate)
        last = slips[-1]
        friction.append(np.nan if last is None or last.friction is None else last.friction / contact.friction)
    return SlipErrors(
        np.array(share).reshape(-1, 3),
        np.array(delays),
        np.array(alarms).reshape(-1, 2),
        np.array(friction),
        np.array(seconds),
    )


def _estimates(
    states: list[SlippingGel],
    look: DegradedGelAppearance,
    gel: ElasticGel,
    estimator: SlipEstimator,
    rate: float,
    seconds: list[float],
) -> list[SlipEstimate | None]:
    renderer, tracker = AccurateGelRenderer(look), MarkerTracker()
    forces = ForceEstimator(gel, look.grid, noise=0.05 / look.pixels_per_mm * 1e-3)
    tracker.start(renderer.render(np.zeros((130, 2))).image)
    found = []
    for image, state in enumerate(states, start=1):
        touch = Contact((look.width / 2, look.height / 2), 3 * look.spacing, min(1.0, image / (_PRESS * rate)))
        result = tracker.track(renderer.render(state.displacement_mm, number=image, contact=touch).image)
        displacement = np.nan_to_num(1e-3 * result.displacement[:, ::-1] / look.pixels_per_mm)
        force = forces.estimate(displacement, result.valid)
        begin = time.perf_counter()
        found.append(estimator.estimate(force, displacement, result.valid, image / rate))
        seconds.append(time.perf_counter() - begin)
    return found


def _delays(states: list[SlippingGel], slips: list[SlipEstimate | None], rate: float) -> list[float]:
    """The time to the alarm for a gross slip at the end that lasts at least 40 ms, otherwise nothing."""
    gross = np.array([state.gross for state in states])
    gross[: round(_PRESS * rate)] = False
    if not gross.any() or not gross[-1]:
        return []
    begin = int(np.flatnonzero(gross)[0])
    if len(gross) - begin < round(0.04 * rate) + 1:
        return []
    alarm = [number for number in range(begin, len(slips)) if (slip := slips[number]) is not None and slip.gross]
    return [(alarm[0] - begin) / rate if alarm else np.inf]
