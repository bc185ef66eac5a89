"""All promises of the runner, each with its scenario, its bound, and the tests that cover it."""

import signal

from gelflow.mock_lab.promises import faults, refusals
from gelflow.mock_lab.promises.faults import blind, interrupted, robot_fault
from gelflow.mock_lab.promises.outcome import Promise
from gelflow.mock_lab.promises.refusals import refused_run
from gelflow.mock_lab.promises.rig import while_lowering

_STOPS = "tests/real/runner/test_stops.py::test_stale_data_or_a_fault_holds_the_arm_and_ends_the_run"
_EGM_STOPS = "tests/real/egm/test_stops.py"
_TOUCH = "tests/real/runner/touch/test_touch.py"
_SIGNAL = "tests/real/runner/test_signals.py::test_signal_stops_the_arm_and_closes_everything"
_PREFLIGHT = "tests/real/runner/test_preflight.py"

_BEFORE_MOTION = (
    Promise(
        "preflight", "the arm does not move before all devices pass their checks: gripper in FAST STOP",
        "motion of the arm", 1.0, "µm",
        refused_run(refusals.gripper_with_fault, "FAST"),
        (f"{_PREFLIGHT}::test_preflight_reports_all_failed_checks_without_motion",),
    ),
    Promise(
        "scale", "a camera's scale that contradicts the printed markers is refused",
        "motion of the arm", 1.0, "µm",
        refused_run(refusals.wrong_scale, "pitch"),
        (f"{_PREFLIGHT}::test_a_scale_that_does_not_fit_the_markers_is_refused",),
    ),
    Promise(
        "one-camera", "one camera under two names is refused",
        "motion of the arm", 1.0, "µm",
        refused_run(refusals.one_camera_for_both, "same images"),
        (f"{_PREFLIGHT}::test_the_same_images_from_both_cameras_are_refused",),
    ),
    Promise(
        "limits", "a lab file with a limit out of range is refused",
        "accepted files", 0.0, "",
        refusals.unbounded_limits,
        ("tests/real/runner/test_lab_file.py::test_numbers_outside_their_range_are_refused_with_key_range_and_value",),
    ),
    Promise(
        "targets", "invalid targets are refused, never clamped",
        "motion of the arm", 1.0, "µm",
        refusals.invalid_targets,
        (
            "tests/real/runner/test_supervisor.py::test_target_outside_the_workspace_is_refused",
            "tests/real/egm/test_motion.py::test_invalid_targets_are_also_refused_in_the_egm_process",
        ),
    ),
    Promise(
        "dry-run", "a dry run sends no motion",
        "references sent", 0.0, "",
        refusals.dry_run,
        (f"{_PREFLIGHT}::test_dry_run_sends_no_motion", "tests/real/wsg/test_stops.py::test_dry_run_sends_no_motion"),
    ),
    Promise(
        "statement", "the code states that this is no safety-rated function",
        "places without the statement", 0.0, "",
        refusals.statement,
        ("tests/project/test_promises.py::test_the_documentation_states_that_this_is_not_safety_rated",),
    ),
)  # fmt: skip

_TOUCHED = (
    Promise(
        "contact", "contact stops the descent",
        "image received to hold sent", 20.0, "ms",
        faults.contact_in_descent,
        ("tests/real/runner/test_insertion_runner.py::test_part_is_inserted_and_the_run_is_recorded",),
    ),
    Promise(
        "contact-approach", "contact stops the approach to a hole that is taught too low",
        "image received to hold sent", 20.0, "ms",
        faults.contact_in_approach,
        (f"{_TOUCH}::test_rim_is_found_by_touch_when_the_hole_is_taught_3_mm_wrong",),
    ),
    Promise(
        "contact-lowering", "contact stops the lowering into the hole",
        "travel from contact above the threshold to rest", 0.1, "mm",
        faults.contact_while_lowering,
        (f"{_TOUCH}::test_rim_is_found_by_touch_when_the_hole_is_taught_3_mm_wrong",),
    ),
    Promise(
        "unreadable", "the arm holds when a pad is not readable in the descent",
        "last readable image to hold", 250.0, "ms",
        blind("blacken"),
        (f"{_TOUCH}::test_part_is_not_moved_without_readable_images",),
    ),
    Promise(
        "unreadable-lowering", "the arm holds when a pad is not readable while the part is lowered",
        "last readable image to hold", 250.0, "ms",
        blind("blacken", when=while_lowering),
        (f"{_TOUCH}::test_part_is_not_moved_without_readable_images",),
    ),
    Promise(
        "frozen-camera", "the arm holds when a camera repeats one image",
        "last new image to hold", 250.0, "ms",
        blind("freeze"),
        ("tests/real/runner/test_frozen_cameras.py::test_cameras_that_freeze_while_a_part_is_moved_end_the_run",),
    ),
    Promise(
        "images", "the arm holds when a camera stops sending",
        "last image to hold", 250.0, "ms",
        blind("stall"),
        (_STOPS,),
    ),
    Promise(
        "weight", "a held part is not moved when a pad does not show its weight",
        "motion of the arm", 5.0, "µm",
        refusals.no_weight,
        ("tests/real/runner/touch/test_grasp_check.py::test_pad_that_does_not_show_the_weight_is_refused",),
    ),
    Promise(
        "release", "a part is not counted as inserted unless both pads show a change at the release",
        "parts called inserted", 0.0, "",
        refusals.release_without_change,
        (
            f"{_TOUCH}::test_insertion_that_the_pads_do_not_show_is_not_believed",
            "tests/real/runner/touch/test_grasp_check.py::test_release_without_a_change_of_the_pads_is_not_believed",
        ),
    ),
    Promise(
        "slip", "slip in the grip ends the attempt",
        "largest push without a stop", 1.0, "mm",
        faults.slip,
        (f"{_TOUCH}::test_pads_with_little_friction_let_no_part_slip_unnoticed",),
    ),
)  # fmt: skip

_ARM = (
    Promise(
        "first-reference", "the first reference equals the measured pose, and every step is bounded",
        "largest step over the allowed one", 1.01, "",
        refusals.largest_steps,
        (
            "tests/real/egm/test_reference_generator.py::"
            "test_first_reference_equals_the_feedback_and_nothing_moves_without_a_target",
            "tests/real/egm/test_reference_generator.py::"
            "test_target_is_reached_exactly_within_the_bounds_of_speed_and_ramp",
        ),
    ),
    Promise(
        "lost-packets", "the arm holds when the pose is stale",
        "time-out to hold", 4.0, "ms",
        faults.lost_packets,
        ("tests/real/egm/test_holds.py::test_stale_feedback_holds_within_one_cycle_of_its_time_out", _STOPS),
    ),
    Promise(
        "motors-off", "emergency stop and motors off latch",
        "switch to latch", 10.0, "ms",
        robot_fault(lambda robot: robot.arm.motors(False), "motors off", latches=True),
        (f"{_EGM_STOPS}::test_motors_off_and_rapid_stop_latch", _STOPS),
    ),
    Promise(
        "program-stopped", "a stopped RAPID program latches",
        "stop to latch", 10.0, "ms",
        robot_fault(lambda robot: robot.arm.rapid(False), "RAPID stopped", latches=True),
        (f"{_EGM_STOPS}::test_motors_off_and_rapid_stop_latch",),
    ),
    Promise(
        "restarted-count", "a message count that starts again latches",
        "restart to latch", 10.0, "ms",
        robot_fault(lambda robot: robot.arm.restart_sequence(), "restarted", latches=True),
        (f"{_EGM_STOPS}::test_sequence_restart_latches",),
    ),
    Promise(
        "attempt-time", "the time of an attempt is limited",
        "end of the time to hold", 100.0, "ms",
        refusals.budget,
        ("tests/real/runner/test_limits_of_attempts.py::test_time_of_an_attempt_is_limited",),
    ),
    Promise(
        "killed-runner", "the arm comes to rest when the runner is killed",
        "kill to rest", 250.0, "ms",
        faults.killed_runner,
        ("tests/real/egm/test_connection.py::test_helper_processes_end_with_their_parent",),
    ),
)  # fmt: skip

_GRIPPER = (
    Promise(
        "gripper-state", "the arm holds when the state of the gripper is stale",
        "last state to hold", 550.0, "ms",
        robot_fault(lambda robot: robot.gripper.begin_fault(1, "stall", "both", {}), "gripper"),
        ("tests/real/wsg/test_link.py::test_silent_peer_times_out",),
    ),
    Promise(
        "fast-stop", "FAST STOP of the gripper ends the run and is never acknowledged",
        "fault to hold", 100.0, "ms",
        robot_fault(lambda robot: robot.gripper.raise_fast_stop(), "FAST"),
        (_STOPS, "tests/real/wsg/test_stops.py::test_fast_stop_forbids_motion_until_acknowledged"),
    ),
    Promise(
        "checksum", "packets of the gripper with a wrong checksum end the run",
        "fault to hold", 550.0, "ms",
        robot_fault(
            lambda robot: robot.gripper.begin_fault(1, "corrupt", "out", {"share": 1.0, "count": 1, "seed": 1}),
            "gripper",
        ),
        ("tests/real/wsg/test_link.py::test_bad_checksum_is_a_fault_until_acknowledged",),
    ),
    Promise(
        "part-lost", "a lost part ends its insertion",
        "loss to hold", 200.0, "ms",
        faults.part_lost,
        ("tests/real/runner/test_insertion_runner.py::test_lost_part_ends_its_insertion_and_the_next_one_starts",),
    ),
    Promise(
        "disconnect", "the arm holds when the gripper disconnects, and a reconnect repeats no command",
        "last state to hold", 550.0, "ms",
        robot_fault(lambda robot: robot.gripper.begin_fault(1, "disconnect", "both", {}), "gripper"),
        ("tests/real/wsg/test_motion.py::test_reconnect_repeats_no_command",),
    ),
)  # fmt: skip

_END = (
    *(
        Promise(
            name, f"{number.name} stops the arm and closes everything",
            "signal to hold", 20.0, "ms",
            interrupted(number),
            (test,),
        )
        for name, number, test in (
            ("ctrl-c", signal.SIGINT, "tests/real/runner/test_stops.py::"
             "test_interrupt_stops_the_arm_and_closes_the_recording"),
            ("sigterm", signal.SIGTERM, _SIGNAL),
            ("sighup", signal.SIGHUP, _SIGNAL),
        )
    ),
    Promise(
        "prompt", "a fault ends the run while the operator is asked",
        "motors off to stop", 10.0, "ms",
        faults.prompt,
        ("tests/real/runner/test_signals.py::test_fault_while_the_operator_is_asked_ends_the_run_at_once",),
    ),
    Promise(
        "slow-disk", "a record that is not stored in time ends the run",
        "first slow write to hold", 1100.0, "ms",
        faults.slow_disk,
        (
            "tests/real/runner/test_stops.py::test_slow_disk_stops_the_arm",
            "tests/session/test_slow_disk.py::test_a_slow_disk_is_noticed_within_the_allowed_delay",
        ),
    ),
    Promise(
        "crash", "a crash loses little of the recording",
        "last recovered record to crash", 500.0, "ms",
        faults.crash_loses_little,
        ("tests/session/test_recover.py::test_a_kill_at_message_500_loses_at_most_half_a_second",),
    ),
    Promise(
        "replay", "a replay gives the same decisions",
        "replays that differ", 0.0, "",
        refusals.replayed,
        ("tests/session/test_replay.py::test_a_replay_is_identical",),
    ),
    Promise(
        "disturbed-links", "duplicated, split and invalid messages never hang the run",
        "duration of the run", 120.0, "s",
        faults.disturbed_links,
        (
            "tests/real/wsg/test_link.py::test_split_duplicated_and_garbage_bytes_are_tolerated",
            "tests/real/egm/test_connection.py::test_invalid_duplicate_and_foreign_messages_are_counted_and_ignored",
            "tests/real/camera/test_codec.py::test_parser_resynchronizes_after_garbage",
        ),
    ),
)  # fmt: skip

PROMISES: dict[str, Promise] = {
    promise.name: promise for promise in (*_BEFORE_MOTION, *_ARM, *_TOUCHED, *_GRIPPER, *_END)
}
