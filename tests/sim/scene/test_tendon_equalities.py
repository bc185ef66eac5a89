"""Equalities of fixed tendons, compared with MuJoCo and with the joint equalities that say the same."""

from pathlib import Path

import pytest
from tests.sim.scene.test_couplings import LOOP, in_mujoco, load, moved

from gelflow.errors import UsageError
from gelflow.sim.benchmark.describe import describe

# Poses of the file that are not 0, in which tendons have lengths.
CHAINS = (
    LOOP.replace("<mujoco>", '<mujoco><compiler angle="radian"/>')
    .replace('name="rod" axis', 'name="rod" ref="0.3" axis')
    .replace('name="rocker" axis', 'name="rocker" ref="0.2" axis')
)
STIFF = 'solref="0.0005 1" solimp="0.9999 0.9999 0.001"'


def tendons(**terms: dict[str, float]) -> str:
    """The XML of fixed tendons: of each the coefficients of its joints."""
    fixed = "".join(
        f'<fixed name="{name}">' + "".join(f'<joint joint="{j}" coef="{c}"/>' for j, c in joints.items()) + "</fixed>"
        for name, joints in terms.items()
    )
    return f"</equality><tendon>{fixed}</tendon><equality>"


def chains(text: str) -> str:
    return CHAINS.replace("EQUALITY", text)


def test_two_joints_of_a_tendon_are_coupled_exactly_as_by_a_joint_equality(tmp_path: Path) -> None:
    tendon = tendons(pair={"crank": 2.0, "rocker": 4.0}) + f'<tendon tendon1="pair" polycoef="0.4" {STIFF}/>'
    scene = load(tmp_path, "tendon.xml", chains(tendon))
    # 2 crank + 4 (rocker − 0.2) = 0.4
    equality = '<joint joint1="rocker" joint2="crank" polycoef="0.1 -0.5"/>'
    same = load(tmp_path, "joint.xml", chains(equality))
    assert (scene.nv, len(scene.tendons), len(scene.couplings)) == (3, 1, 1)
    sim, other = moved(scene, 0.3, 150), moved(same, 0.3, 150)
    assert abs(sim.q[0, 0]) > 0.1, "it moves"
    assert sim.q == pytest.approx(other.q, abs=1e-9)
    assert 2 * sim.q[0, 0] + 4 * (sim.q[0, 2] - 0.2) == pytest.approx(0.4, abs=1e-14)


@pytest.mark.parametrize(
    "equality",
    [
        tendons(all={"crank": 1.0, "rod": -0.5, "rocker": 2.0}) + f'<tendon tendon1="all" {STIFF}/>',
        tendons(one={"rocker": 2.0}, two={"crank": 1.0, "rod": 0.5})
        + f'<tendon tendon1="one" tendon2="two" polycoef="0 -0.7" {STIFF}/>',
        tendons(one={"rocker": 2.0}, two={"crank": 0.5})
        + f'<tendon tendon1="one" tendon2="two" polycoef="0 1.5 2" {STIFF}/>',
        tendons(one={"rod": 1.0, "crank": -1.0}, two={"crank": 3.0})
        + f'<tendon tendon1="one" tendon2="two" polycoef="0 0.5" {STIFF}/>',
    ],
    ids=["three joints", "two tendons of three joints", "curved", "two tendons of two joints"],
)
def test_motion_is_that_of_mujoco(equality: str, tmp_path: Path) -> None:
    scene = load(tmp_path, "chains.xml", chains(equality))
    sim = moved(scene, 0.3, 80)
    expected = in_mujoco(tmp_path / "chains.xml", 0.3, 0.08)
    assert abs(expected[0]) > 0.1, "it moves"
    assert sim.q[0] == pytest.approx(expected, abs=2e-3)


def test_a_joint_may_be_in_the_tendons_of_several_equalities(tmp_path: Path) -> None:
    """The rocker would follow both others: the second equality is turned round."""
    text = tendons(a={"crank": 1.0, "rocker": 1.0}, b={"rod": 1.0, "rocker": -1.0})
    sim = moved(load(tmp_path, "chains.xml", chains(text + '<tendon tendon1="a"/><tendon tendon1="b"/>')), 0.3, 100)
    crank, rod, rocker = sim.q[0]
    assert abs(crank) > 0.1
    assert (rocker, rod) == (pytest.approx(0.2 - crank, abs=1e-14), pytest.approx(0.3 + rocker - 0.2, abs=1e-14))


def test_a_tendon_of_one_joint_fixes_it(tmp_path: Path) -> None:
    text = tendons(only={"rocker": 2.0}) + '<tendon tendon1="only" polycoef="0.2"/>'
    assert moved(load(tmp_path, "chains.xml", chains(text)), 0.3, 50).q[0, 2] == pytest.approx(0.3, abs=1e-15)


def test_describe_lists_the_equality_of_three_joints(tmp_path: Path) -> None:
    text = tendons(all={"crank": 1.0, "rod": -0.5, "rocker": 2.0}) + '<tendon name="all" tendon1="all"/>'
    lines = describe(load(tmp_path, "chains.xml", chains(text))).couplings
    assert any("all equality" in line for line in lines), lines


def test_curved_equality_of_three_joints_is_refused(tmp_path: Path) -> None:
    text = tendons(one={"rocker": 2.0}, two={"crank": 1.0, "rod": 0.5})
    with pytest.raises(UsageError, match="equality tendon of 'one' and 'two' is not supported: remove it"):
        load(tmp_path, "chains.xml", chains(text + '<tendon tendon1="one" tendon2="two" polycoef="0 1 1"/>'))


def test_equality_of_a_spatial_tendon_is_refused(tmp_path: Path) -> None:
    text = '</equality><tendon><spatial name="rope"><site site="rod tip"/><site site="rocker tip"/></spatial></tendon>'
    with pytest.raises(UsageError, match="equality tendon of 'rope' is not supported"):
        load(tmp_path, "chains.xml", chains(text + '<equality><tendon tendon1="rope"/>'))
