"""Random fault plans: a plan with one or two faults for each seed, over all devices, kinds, events and durations."""

import random

from gelflow.hardware_mocks.faults.plan import DIRECTIONS, EVENTS, KINDS, Fault, FaultPlan, parameters_of
from gelflow.task import INSERTION

_DOUBLE = 0.35  # fraction of the plans with two faults
_ENDLESS = 0.4  # fraction of the faults that last until the end of the run
_DURATION = (0.05, 8.0)  # of the others, uniform in the logarithm [s]
_LATEST = 35.0  # latest start of a fault at a given time [s]
_SHARES = (0.05, 0.3, 0.7, 1.0)
_DELAYS = (0.02, 0.08, 0.3, 1.0)
_RANGES = {"zoom": (0.75, 1.3), "factor of stiff_gel": (2.0, 10.0), "factor of slip": (0.05, 0.5)}


def random_plan(seed: int) -> FaultPlan:
    """The fault plan of a seed: one fault, or two. Equal seeds give equal plans."""
    rng = random.Random(f"fault plan {seed}")
    count = 2 if rng.random() < _DOUBLE else 1
    return FaultPlan(tuple(_random_fault(rng) for _ in range(count)))


def _random_fault(rng: random.Random) -> Fault:
    kind = rng.choice(sorted(KINDS))
    device = rng.choice(KINDS[kind].devices)
    momentary = KINDS[kind].momentary
    two_way = KINDS[kind].message and device in ("arm", "gripper")
    low, high = _DURATION
    lasting = {} if momentary or rng.random() < _ENDLESS else {"duration": round(low * (high / low) ** rng.random(), 3)}
    return Fault(
        device=device,
        kind=kind,
        direction=rng.choice(DIRECTIONS) if two_way else "both",
        seed=rng.randrange(10**6),
        parameters=_random_parameters(kind, device, rng),
        **lasting,
        **_random_begin(rng),  # type: ignore[arg-type]
    )


def _random_begin(rng: random.Random) -> dict[str, float | int | str]:
    choice = rng.choice(("at", "random", *EVENTS, "descent", "lowering"))  # the last two twice as often
    if choice == "at":
        return {"at": round(rng.uniform(0.0, _LATEST), 2)}
    if choice == "random":
        return {"rate": round(rng.uniform(0.02, 0.3), 3)}
    begin: dict[str, float | int | str] = {"event": choice}
    if rng.random() < 0.5:
        begin["after"] = round(rng.uniform(0.0, 2.0), 3)
    if choice in ("attempt", "descent"):
        begin["attempt"] = rng.randint(1, 3)
    if choice == "descent":
        begin["below"] = round(INSERTION.start_height - rng.uniform(0.1e-3, INSERTION.descent), 6)
    if choice == "lowering":
        begin["below"] = round(rng.uniform(0.003, INSERTION.start_height - INSERTION.descent - 0.2e-3), 6)
    return begin


def _random_parameters(kind: str, device: str, rng: random.Random) -> dict[str, float]:
    values: dict[str, float] = {}
    for name in parameters_of(kind, device):
        if name == "share":
            values[name] = rng.choice(_SHARES)
        elif name == "delay":
            values[name] = rng.choice(_DELAYS)
        elif name == "count":
            values[name] = rng.choice((1, 10, 500))
        elif name == "loop":
            values[name] = rng.choice((1, 1, 3, 8))
        else:
            low, high = _RANGES.get(name) or _RANGES[f"{name} of {kind}"]
            values[name] = round(rng.uniform(low, high), 3)
    return values
