"""The content of a drawing: points and directions of contact forces, sizes of an environment, surfaces of meshes."""

import numpy as np
import pytest

import gelflow.sim as gs
from gelflow.errors import UsageError
from gelflow.part import Part
from gelflow.sim.drawing.scene_drawing import grid_mesh, scene_drawing
from gelflow.sim.scene.geometry.distance_grid import distance_grid
from gelflow.sim.tasks.parts.part_scene import HOLE, WALLS, with_part
from gelflow.sim.validation.reference_meshes import sphere


def test_weight_of_a_ball_acts_upwards_at_its_lowest_point() -> None:
    scene = gs.load_scene("rolling", overrides={"pads.pad.rows": 10, "pads.pad.cols": 10})
    sim = gs.Simulator(scene)
    up = np.array(scene.q0)
    up[sim.joint_q("pad_z")] += 0.1  # the pad far above the ball
    sim.q[:] = up
    for _ in range(300):
        sim.step(np.zeros(scene.nu))
        sim.q[:, sim.joint_q("pad_z")] = up[sim.joint_q("pad_z")]
        sim.v[:, sim.joint_v("pad_z")] = 0
        sim.clear_history()
    drawing = scene_drawing(sim)
    (contact,) = drawing.contacts
    mass = float(sim.param("ball.mass")[0])
    ball = drawing.poses[scene.body("ball")].position
    np.testing.assert_allclose(contact.force, [0, 0, 9.8 * mass], atol=0.02 * 9.8 * mass)
    np.testing.assert_allclose(contact.point[:2], ball[:2], atol=1e-9)
    np.testing.assert_allclose(contact.point[2], ball[2] - float(sim.param("ball.size.x")[0]), atol=1e-6)


def test_scenes_with_colliding_pads_are_drawn() -> None:
    sim = gs.Simulator(gs.load_scene("insertion", overrides={"pads.*.collides": True}))
    assert len(sim.wrenches()[0]) > len(gs.load_scene("insertion").contacts)
    assert len(scene_drawing(sim).pads) == 2


def test_geometries_have_the_size_and_place_of_their_environment() -> None:
    sim = gs.Simulator(gs.load_scene("insertion"), num_envs=2)
    sim.param("part.size.x")[1] = 0.01
    sim.param("wall_left.shape.pos.x")[1] = -0.06
    drawn = {geom.name: geom for geom in scene_drawing(sim, 1).geoms}
    assert drawn["part"].size[0] == 0.01
    assert drawn["wall_left"].pose.position[0] == -0.06
    assert drawn["pad_left"].kind == "cylinder"  # a geometry of the model file that is no shape
    assert {geom.name: geom for geom in scene_drawing(sim, 0).geoms}["part"].size[0] == 0.0175


def test_hole_of_another_part_replaces_the_walls() -> None:
    peg = Part(name="peg", shape="cylinder", size=(0.03, 0.03, 0.06), clearance=(2e-3, 2e-3), depth=0.02)
    sim = gs.Simulator(with_part(gs.load_scene("insertion"), peg))
    names = [geom.name for geom in scene_drawing(sim).geoms]
    assert HOLE in names and not set(WALLS) & set(names)


def test_surface_of_a_distance_grid_is_that_of_its_mesh() -> None:
    mesh = sphere(0.02)
    surface = grid_mesh(distance_grid(mesh, "ball", resolution=24))
    radii = np.linalg.norm(surface.vertices, axis=1)
    assert np.abs(radii - 0.02).max() < 0.02 * 0.03
    assert surface.volume() > 0  # oriented outwards


def test_wrong_environment_and_core_model_are_refused() -> None:
    scene = gs.load_scene("pushing")
    with pytest.raises(UsageError, match="env must be below 1"):
        scene_drawing(gs.Simulator(scene), 1)
    with pytest.raises(UsageError, match="core model cannot be drawn"):
        scene_drawing(gs.Simulator(scene.build()))


def test_a_contact_of_a_larger_box_is_drawn_where_its_force_acts() -> None:
    scene = gs.load_scene("pushing")
    sim, box = gs.Simulator(scene), next(shape for shape in scene.shapes if shape.name == "box")
    for axis, half in zip("xy", box.size[:2], strict=True):
        sim.param(f"box.size.{axis}")[:] = 1.4 * half
        sim.param(f"box.points.scale.{axis}")[:] = 1.4
    sim.q[0, scene.q("box_x").start] += 0.4 * box.size[0]
    push = np.zeros(scene.nu)
    push[scene.u("gripper_x")] = 1.0
    sim.step(push, 60)
    drawn = {contact.name: contact for contact in scene_drawing(sim).contacts}["pad_box"]
    moment, force = np.split(sim.wrenches()[0, sim.model.contact_names.index("pad_box")], 2)
    np.testing.assert_allclose(np.cross(drawn.point, force), moment, atol=1e-3 * float(np.linalg.norm(force)))


def test_scenes_and_readings_are_compared_by_identity() -> None:
    scene = gs.load_scene("rolling")
    assert scene != gs.load_scene("rolling") and scene in {scene}


def test_markers_are_where_the_parameters_of_their_pad_put_them() -> None:
    sim = gs.Simulator(gs.load_scene("rolling", overrides={"pads.pad.rows": 3, "pads.pad.cols": 3}))
    before = scene_drawing(sim).pads[0].positions
    sim.param("pad.markers.pos.x")[:] += 0.01
    np.testing.assert_allclose(scene_drawing(sim).pads[0].positions - before, [[0.01, 0, 0]] * 9, atol=1e-12)
