"""Drive a WSG-50 gripper. The mock answers on TCP; for a real gripper replace the address."""

from gelflow.clock import ScaledClock
from gelflow.hardware_mocks import KinematicGripper, MockWsgGripper
from gelflow.real import WsgGripper, transport_for

clock = ScaledClock(5.0)  # the mock runs five times as fast as real time; use 1.0 for a real gripper
plant = KinematicGripper(clock, width=0.050, part_width=0.025)  # a rigid part between the fingers [m]
with MockWsgGripper(plant, clock=clock, serial=False, tcp_port=0) as mock:
    host, port = mock.tcp_address
    address = f"tcp:{host}:{port}"  # a real gripper: "tcp:192.168.1.20:1000" or "serial:/dev/ttyUSB0"
    with WsgGripper(transport_for(address, clock=clock), clock=clock) as gripper:
        gripper.home()
        gripper.move(width=0.060, speed=0.1)
        gripper.grasp(width=0.025, speed=0.05, force=20)
        state = gripper.state()
        print(f"width {1e3 * state.width:.1f} mm, force {state.force:.1f} N, {state.grasp}")
        gripper.release(width=0.060, speed=0.05)
