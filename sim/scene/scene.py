"""The description of a scene as plain, immutable data."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import UsageError
from gelflow.observation import Grid
from gelflow.sim.arguments import shown
from gelflow.sim.scene.contacts import ContactDef, PointsDef
from gelflow.sim.scene.joint_limits import JointLimit
from gelflow.sim.scene.mjcf.actuators import ActuatorDef
from gelflow.sim.scene.mjcf.couplings import CouplingDef, LoopClosureDef, TendonDef
from gelflow.sim.scene.mjcf.mechanics import BodyDef, GeomDef, JointDef, SiteDef
from gelflow.sim.scene.pads import PadDef
from gelflow.sim.scene.shapes import ShapeDef
from gelflow.toml_tables import suggestion

if TYPE_CHECKING:
    from gelflow.sim import _core

Array = NDArray[np.float64]
Precision = Literal["double", "single"]

DEFAULT_TOLERANCE = 1e-7  # of Newton's method
DEFAULT_INTEGRATOR = "bdf2"  # the reasons are in docs/reference/accuracy.md


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene: bodies, joints, actuators, contact geometry and tactile pads.

    `load_scene` reads a scene from files; `dataclasses.replace` makes a changed copy. Bodies, joints and actuators are
    in the order of the model file, contacts and pads in the order of the TOML file. Elements refer to bodies and joints
    by index, to shapes and points by name.
    """

    name: str
    path: Path  # of the TOML file, or of a model file without one; names the scene in error messages
    step: float  # time step [s]
    bodies: tuple[BodyDef, ...]  # parents before children
    joints: tuple[JointDef, ...]
    limits: tuple[JointLimit, ...]  # one per joint
    q0: Array  # initial positions, shape (nq,)
    keyframe_controls: Array | None = None  # of the keyframe that gives q0, shape (nu,); None: it has none
    integrator: str = DEFAULT_INTEGRATOR  # or "bdf1"
    tolerance: float = DEFAULT_TOLERANCE  # of Newton's method, see docs/reference/physics.md
    max_step_iterations: int = 1000  # of Newton's method, in all attempts at a step, beyond which the step fails
    precision: Precision = "double"  # default precision of a `Simulator` of this scene
    friction: str = "viscous"  # friction law of contacts and pads that set none: "viscous" or "elastic"
    gravity: Array = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))  # [m/s²], shape (3,)
    tendons: tuple[TendonDef, ...] = ()  # the fixed ones
    couplings: tuple[CouplingDef, ...] = ()
    loop_closures: tuple[LoopClosureDef, ...] = ()
    actuators: tuple[ActuatorDef, ...] = ()
    shapes: tuple[ShapeDef, ...] = ()
    points: tuple[PointsDef, ...] = ()
    contacts: tuple[ContactDef, ...] = ()
    pads: tuple[PadDef, ...] = ()
    sites: tuple[SiteDef, ...] = ()  # in the order of the model file; in a URDF the link frames
    geoms: tuple[GeomDef, ...] = ()  # of the model file, for pictures; the simulation uses shapes and points
    not_modelled: tuple[str, ...] = ()  # elements of the files without effect in the simulation, with the reason
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # name -> dotted key -> value

    @property
    def nq(self) -> int:
        """Number of generalized positions."""
        return sum(joint.nq for joint in self.joints)

    @property
    def nv(self) -> int:
        """Number of generalized velocities."""
        return sum(joint.nv for joint in self.joints)

    @property
    def nu(self) -> int:
        """Number of controls."""
        return len(self.actuators)

    @property
    def num_markers(self) -> int:
        """Total number of markers of all pads."""
        return sum(len(pad.positions) for pad in self.pads)

    @property
    def grids(self) -> tuple[Grid, ...]:
        """The marker grid of each pad [mm]. Raises UsageError if a pad is not a rectangle."""
        if no_grid := [pad.name for pad in self.pads if pad.grid is None]:
            raise UsageError(f"{self.path}: pad {no_grid[0]!r} is not a rectangle and has no marker grid")
        return tuple(pad.grid for pad in self.pads if pad.grid is not None)

    def q(self, joint: str) -> slice:
        """The slice of q with the positions of a joint. Raises UsageError on an unknown name."""
        definition = self._joint(joint)
        return slice(definition.q_start, definition.q_start + definition.nq)

    def v(self, joint: str) -> slice:
        """The slice of v with the velocities of a joint. Raises UsageError on an unknown name."""
        definition = self._joint(joint)
        return slice(definition.v_start, definition.v_start + definition.nv)

    def u(self, actuator: str) -> int:
        """The index of an actuator in u. Raises UsageError on an unknown name."""
        return _index("actuator", actuator, [actuator.name for actuator in self.actuators])

    def driven_joints(self, actuator: ActuatorDef) -> tuple[tuple[JointDef, float], ...]:
        """The joints that an actuator drives, each with its coefficient: 1, or that of the actuator's tendon."""
        if actuator.tendon < 0:
            return ((self.joints[actuator.joint], 1.0),)
        tendon = self.tendons[actuator.tendon]
        return tuple((self.joints[j], c) for j, c in zip(tendon.joints, tendon.coefficients, strict=True))

    def body(self, name: str) -> int:
        """The index of a moving body. Raises UsageError on an unknown name."""
        return _index("moving body", name, [body.name for body in self.bodies])

    def site(self, name: str) -> int:
        """The index of a site. Raises UsageError on an unknown name."""
        return _index("site", name, [site.name for site in self.sites])

    def contact_names(self, contact: str) -> tuple[str, ...]:
        """Names in the model of a contact of the TOML file, one per shape. Raises UsageError on an unknown name."""
        _index("contact", contact, [c.group for c in self.contacts])
        return tuple(c.name for c in self.contacts if c.group == contact)

    def marker_slice(self, pad: str) -> slice:
        """The slice of the tactile forces with the markers of a pad. Raises UsageError on an unknown name."""
        index = _index("pad", pad, [p.name for p in self.pads])
        start = sum(len(p.positions) for p in self.pads[:index])
        return slice(start, start + len(self.pads[index].positions))

    def model_spec(self) -> "_core.ModelSpec":
        """The definitions of all elements of the scene, from which the C++ core builds a model.

        Raises ValueError if they are inconsistent.
        """
        from gelflow.sim import _core  # lazy: loading a scene does not need the compiled core
        from gelflow.sim.scene.model_spec import add_actuators, add_bodies, add_contacts, add_couplings

        spec = _core.ModelSpec()
        spec.gravity = self.gravity
        spec.step = self.step
        spec.integrator = self.integrator
        spec.tolerance = self.tolerance
        spec.max_step_iterations = self.max_step_iterations
        add_bodies(spec, self.bodies, self.joints, self.limits)
        add_contacts(spec, self.shapes, self.points, self.contacts, self.pads)
        add_couplings(spec, self.tendons, self.couplings, self.loop_closures)
        add_actuators(spec, self.actuators)
        return spec

    def build(self) -> "_core.Model":
        """The model of the scene in the C++ core. Raises UsageError if elements are inconsistent."""
        from gelflow.sim import _core

        try:
            return _core.Model(self.model_spec())
        except UsageError:
            raise
        except KeyError as error:
            raise UsageError(f"{self.path}: a contact or pad refers to {error}, which the scene lacks") from None
        except ValueError as error:
            raise UsageError(f"{self.path}: {error}") from None
        except TypeError as error:  # of pybind11, whose message has many lines
            raise UsageError(f"{self.path}: a value has a wrong type or shape: {str(error).splitlines()[0]}") from None

    def _joint(self, name: str) -> JointDef:
        return self.joints[_index("joint", name, [joint.name for joint in self.joints])]


def _index(kind: str, name: str, names: list[str]) -> int:
    if not isinstance(name, str) or name not in names:
        raise UsageError(f"no {kind} {shown(name)}; {suggestion(name, names)}")
    return names.index(name)
