"""Frames meet the inertial data (or pose) that reaches past them; bad input is dropped, counted and explained."""
from __future__ import annotations

import threading

import numpy as np
import pytest

from line_slam_ros.geometry.lie import rigid, so3_exp, so3_log
from line_slam_ros.imu_buffer import ImuBuffer
from line_slam_ros.inbox import Inbox, PoseInbox
from line_slam_ros.pose_buffer import PoseBuffer
from line_slam_ros.types import Frame

MS = 1_000_000
START = 100_000 * MS
GRAVITY = (0.0, 0.0, 9.81)
STILL = (0.0, 0.0, 0.0)


def frame(ms: float, width: int = 4) -> Frame:
    return Frame(START + round(ms * MS), np.zeros((3, width), np.uint8))


def feed(inbox: Inbox, *ms: float) -> None:
    for t in ms:
        inbox.imu(START + round(t * MS), STILL, GRAVITY)


def times(pair) -> tuple[float, list[float]]:
    taken, imu = pair
    return (taken.t_ns - START) / MS, ((imu.t_ns - START) / MS).tolist()


def test_a_frame_waits_for_the_imu_to_reach_it():
    inbox = Inbox(3)
    feed(inbox, 0, 5)
    inbox.frame(frame(7))
    assert inbox.take() is None
    feed(inbox, 10)
    assert times(inbox.take()) == (7, [0, 5, 10])
    assert inbox.take() is None and not inbox.drops and not inbox.notes()


def test_batches_overlap_so_that_they_cover_the_time_between_frames():
    inbox = Inbox(3)
    for t in (7, 15, 22):
        inbox.frame(frame(t))
    feed(inbox, *range(0, 30, 5))
    assert [times(inbox.take()) for _ in range(3)] == [(7, [0, 5, 10]), (15, [5, 10, 15]), (22, [15, 20, 25])]


def test_time_offset_moves_frames_into_the_clock_of_the_imu():
    inbox = Inbox(3, time_offset=0.004)
    feed(inbox, 0, 5, 10)
    inbox.frame(frame(3))
    assert times(inbox.take()) == (7, [0, 5, 10])


def test_frames_before_any_imu_are_dropped_and_counted():
    inbox = Inbox(3)
    inbox.frame(frame(-10))
    inbox.frame(frame(3))
    feed(inbox, 0, 5)
    assert times(inbox.take())[0] == 3
    assert inbox.drops == {'image without IMU': 1}
    assert 'before the first message' in inbox.notes()[0]


def test_no_imu_at_all():
    inbox = Inbox(2)
    for t in range(5):
        inbox.frame(frame(t))
    inbox.close()
    assert inbox.take() is None
    assert inbox.drops == {'image without IMU': 5}
    assert inbox.notes() == ['image dropped: no IMU message has come: check the topic name and that it is published']


def test_too_many_images_lose_the_oldest():
    inbox = Inbox(2)
    feed(inbox, *range(0, 100, 5))
    for t in (10, 20, 30, 40):
        inbox.frame(frame(t))
    assert [times(inbox.take())[0] for _ in range(2)] == [30, 40]
    assert inbox.drops == {'image too many': 2}
    assert 'Lower the camera rate' in inbox.notes()[0]


@pytest.mark.parametrize('late', [10, 4])
def test_repeated_and_decreasing_stamps_are_dropped(late):
    inbox = Inbox(3)
    feed(inbox, 0, 5, 10, late, 15)
    inbox.frame(frame(12))
    inbox.frame(frame(12))
    inbox.frame(frame(11))
    assert times(inbox.take()) == (12, [0, 5, 10, 15])
    assert inbox.take() is None
    assert inbox.drops == {'IMU stamp not increasing': 1, 'image stamp not increasing': 2}
    assert len(inbox.notes()) == 2  # each told once


@pytest.mark.parametrize('bad', [float('nan'), float('inf')])
def test_samples_that_are_not_finite_are_dropped(bad):
    inbox = Inbox(3)
    feed(inbox, 0)
    inbox.imu(START + 5 * MS, (0.0, bad, 0.0), GRAVITY)
    inbox.imu(START + 6 * MS, STILL, (bad, 0.0, 0.0))
    feed(inbox, 10)
    inbox.frame(frame(8))
    assert times(inbox.take()) == (8, [0, 10])
    assert inbox.drops == {'IMU not finite': 2}


def test_gaps_in_the_imu_are_reported():
    inbox = Inbox(3)
    feed(inbox, *range(0, 200, 5), *range(300, 400, 5))
    assert inbox.drops == {'IMU gap': 1}
    assert inbox.notes()[0].startswith('IMU data missing for 0.105 s')


@pytest.mark.parametrize(('accel', 'says'), [(1.0, 'in g'), (0.02, 'gravity seems to be removed')])
def test_wrong_accelerometer_units_are_told(accel, says):
    inbox = Inbox(3)
    for i in range(400):
        inbox.imu(START + 5 * i * MS, STILL, (0.0, 0.0, accel))
    note, = inbox.notes()
    assert says in note


def test_degrees_per_second_are_told():
    inbox = Inbox(3)
    inbox.imu(START, (0.0, 90.0, 0.0), GRAVITY)
    assert 'not deg/s' in inbox.notes()[0]


def test_accel_scale_turns_g_into_metres_per_second_squared():
    inbox = Inbox(3, accel_scale=9.80665)
    for i in range(400):
        inbox.imu(START + 5 * i * MS, STILL, (0.0, 0.0, 1.0))
    inbox.frame(frame(0))
    assert not inbox.notes()
    np.testing.assert_array_equal(inbox.take()[1].accel_B, [[0.0, 0.0, 9.80665]])


def test_notes_of_one_reason_come_at_most_every_ten_seconds_of_message_time():
    inbox = Inbox(3)
    for second in range(25):
        feed(inbox, 1000 * second)
        inbox.imu(START + round(1000.5 * second) * MS, STILL, (np.nan, 0.0, 0.0))
    assert inbox.drops == {'IMU not finite': 25} and len(inbox.notes()) == 3


@pytest.mark.parametrize('imu_first', [True, False])
def test_time_jumping_back_starts_again_and_marks_the_first_pair_after(imu_first):
    inbox = Inbox(3)
    feed(inbox, 5000, 5005, 5010)
    inbox.frame(frame(5003))
    assert inbox.take() and not inbox.jumped
    inbox.frame(frame(5020))
    if imu_first:
        feed(inbox, 0, 5)
        inbox.frame(frame(3))
    else:
        inbox.frame(frame(3))
        feed(inbox, 0, 5)
    inbox.frame(frame(4))
    assert times(inbox.take()) == (3, [0, 5]) and inbox.jumped
    assert times(inbox.take()) == (4, [0, 5]) and not inbox.jumped
    assert inbox.drops['image waiting when time jumped back'] == 1
    assert inbox.notes()[0].endswith('starting again')


def test_images_of_another_size_than_calibrated_are_dropped():
    inbox = Inbox(3, size=(4, 3))
    feed(inbox, 0, 10)
    inbox.frame(frame(3, width=5))
    assert inbox.take() is None
    assert inbox.drops == {'image size differs from the calibration': 1}
    assert 'image is 5x3, the calibration is for 4x3' in inbox.notes()[0]


def test_imu_forgotten_during_a_long_pause_of_the_camera_is_reported():
    inbox = Inbox(3, imu_capacity=16)
    feed(inbox, 0, 5)
    inbox.frame(frame(3))
    inbox.take()
    feed(inbox, *range(10, 300, 5))
    inbox.frame(frame(290))
    assert inbox.take() and inbox.drops == {'IMU forgotten': 1}


def test_iteration_blocks_until_a_pair_is_ready_and_ends_after_close():
    inbox, seen = Inbox(10), []
    worker = threading.Thread(target=lambda: seen.extend(times(pair)[0] for pair in inbox))
    worker.start()
    inbox.frame(frame(3))
    inbox.frame(frame(8))
    feed(inbox, 0, 5, 10)
    inbox.frame(frame(20))
    inbox.close()
    worker.join(10)
    assert not worker.is_alive() and seen == [3, 8]
    assert inbox.drops == {'image without IMU': 1}
    assert 'end 0.01 s before it' in inbox.notes()[0]


def test_what_the_shell_rejects_is_counted_and_told():
    inbox = Inbox(3)
    inbox.reject('image not usable', 'encoding is strange', START)
    assert inbox.drops == {'image not usable': 1} and inbox.notes() == ['encoding is strange']


def test_imu_buffer_keeps_fixed_memory_and_the_newest_samples():
    buffer = ImuBuffer(8)
    arrays = buffer._t, buffer._gyro, buffer._accel
    for i in range(100):
        buffer.push(i, (i, 0.0, 0.0), GRAVITY)
    batch = buffer.take_until(99)
    assert arrays[0] is buffer._t and 4 <= len(batch.t_ns) <= 8
    np.testing.assert_array_equal(batch.t_ns, np.arange(100 - len(batch.t_ns), 100))
    np.testing.assert_array_equal(batch.gyro_B[:, 0], batch.t_ns)


def test_poses_are_interpolated_to_the_image():
    w, p = np.array([0.4, -0.2, 0.1]), np.array([1.0, 2.0, 3.0])
    inbox = PoseInbox(3)
    inbox.frame(frame(25))
    inbox.pose(START, np.eye(4))
    assert inbox.take() is None
    inbox.pose(START + 100 * MS, rigid(so3_exp(w), p))
    taken, T_WB = inbox.take()
    assert taken.t_ns == START + 25 * MS
    np.testing.assert_allclose(so3_log(T_WB[:3, :3]), 0.25 * w, atol=1e-12)
    np.testing.assert_allclose(T_WB[:3, 3], 0.25 * p, atol=1e-12)


def test_poses_are_not_interpolated_over_gaps_nor_before_the_first():
    inbox = PoseInbox(3)
    inbox.frame(frame(-1))
    inbox.frame(frame(300))
    inbox.frame(frame(1000))
    inbox.pose(START, np.eye(4))
    inbox.pose(START + 1000 * MS, np.eye(4))
    assert inbox.take()[0].t_ns == START + 1000 * MS
    assert inbox.drops == {'image without pose': 2}


def test_pose_time_jumping_back_starts_again():
    inbox = PoseInbox(3)
    inbox.pose(START + 5000 * MS, np.eye(4))
    inbox.pose(START, np.eye(4))
    inbox.frame(frame(0))
    assert inbox.take()[0].t_ns == START and inbox.jumped


def test_pose_buffer_keeps_fixed_memory_and_the_newest_poses():
    buffer = PoseBuffer(8)
    memory = buffer._T
    for i in range(100):
        buffer.push(i, rigid(np.eye(3), [float(i), 0.0, 0.0]))
    assert buffer._T is memory
    assert [buffer.at(t)[0, 3] for t in (97, 98, 99)] == [97.0, 98.0, 99.0]
    assert buffer.at(0) is None and buffer.at(100) is None


@pytest.mark.parametrize('buffer', [ImuBuffer(4), PoseBuffer(4)])
def test_buffers_refuse_stamps_that_do_not_increase(buffer):
    arguments = (STILL, GRAVITY) if isinstance(buffer, ImuBuffer) else (np.eye(4),)
    buffer.push(5, *arguments)
    with pytest.raises(ValueError, match='5 is not after 5'):
        buffer.push(5, *arguments)


def test_size_can_be_expected_later():
    inbox = Inbox(3)
    inbox.expect_size((4, 3))
    inbox.frame(frame(3, width=5))
    assert inbox.drops == {'image size differs from the calibration': 1}


def test_ready_counts_the_frames_that_wait_for_the_taker_only():
    inbox = Inbox(5)
    for t in (3, 8, 20):
        inbox.frame(frame(t))
    feed(inbox, 0, 5, 10)
    assert inbox.ready == 2  # the third waits for the IMU
    inbox.take()
    assert inbox.ready == 1


def test_the_time_a_frame_waited_is_known(monkeypatch):
    clock = iter([10.0, 10.5, 13.0, 13.25])
    monkeypatch.setattr('line_slam_ros.inbox.time.monotonic', lambda: next(clock))
    inbox = Inbox(1)
    feed(inbox, 0, 5, 10)
    inbox.frame(frame(3))
    inbox.frame(frame(4))  # takes the place of the first
    inbox.take()
    assert inbox.waited == 2.5
