"""What the node knows about itself."""
from __future__ import annotations

import pytest

from line_slam_ros.nodes.health import Latency, Recent, Stream, refinement
from line_slam_ros.types import RigCorrection


def test_rate_counts_arrivals_since_the_last_measurement() -> None:
    stream = Stream('images', '/image', 'image')
    for k in range(10):
        stream.arrived(0.1 * k)
    assert stream.measure(0.5) == stream.hz == 20.0
    assert stream.measure(1.0) == 0.0
    assert (stream.total, stream.last) == (10, pytest.approx(0.9))


@pytest.mark.parametrize('publishers,total,cause', [
    (0, 0, 'nobody publishes /cam; remap with --ros-args -r image:='),
    (1, 0, '/cam has a publisher but nothing arrives; compare its QoS'),
    (1, 5, 'images on /cam stopped'),
])
def test_silence_tells_the_likely_cause(publishers: int, total: int, cause: str) -> None:
    stream = Stream('images', '/cam', 'image')
    for _ in range(total):
        stream.arrived(0.0)
    assert cause in stream.silence(publishers)


def test_latency_is_mean_and_worst_by_stage() -> None:
    latency = Latency()
    latency.add({'track': 0.010, 'total': 0.020})
    latency.add({'track': 0.030, 'total': 0.040})
    assert latency.summary() == {'latency track': '20.0 ms, worst 30.0 ms', 'latency total': '30.0 ms, worst 40.0 ms'}
    assert Latency().summary() == {}


def test_recent_sentences_are_forgotten_in_time() -> None:
    now = [0.0]
    recent = Recent(10.0, lambda: now[0])
    recent.add('first')
    now[0] = 6.0
    recent.add('second')
    assert recent.sentences() == ['first', 'second']
    now[0] = 11.0
    assert recent.sentences() == ['second']
    recent.add('first')
    assert sorted(recent.sentences()) == ['first', 'second']


def test_refinement_of_the_calibration_is_told_in_degrees_and_milliseconds():
    assert refinement(None) == {}
    assert refinement(RigCorrection(0.123, 0.0045, -0.00512)) == {
        'camera to IMU': 'refined by 0.12 deg, 4.5 mm', 'time offset': 'refined by -5.12 ms'}
