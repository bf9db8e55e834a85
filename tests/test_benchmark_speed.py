"""The benchmark of the speed: its arithmetic, and every part of it on a second or two of the shipped recording."""
from __future__ import annotations

import json
import os
import time
from dataclasses import replace

import numpy as np
import pytest
from bag_samples import OFFICE, line_slam

from line_slam_ros.benchmark import speed_growth as growth
from line_slam_ros.benchmark import speed_live as live
from line_slam_ros.benchmark import speed_memory as memory
from line_slam_ros.benchmark import speed_stages as stages
from line_slam_ros.benchmark.speed_reference import (
    comparison,
    in_kernels,
    ratios,
    read_references,
    write_reference,
)
from line_slam_ros.cli import benchmark_parts, benchmark_speed
from line_slam_ros.cli.benchmark_source import Recording, Tape, in_child, opened, surroundings
from line_slam_ros.config import Estimator, Mapping
from line_slam_ros.mapping.line_map import LineMap

CLIP = Recording(OFFICE / 'bag', duration_s=2.2)
FEW = growth.Sizes(points=(60,), lines=(10,), window=(6,), image=(0.5,), corners=(50,), segments=(20,), map=(30, 60),
                   seconds=3.5)


@pytest.fixture(scope='module')
def profile():
    """Of the clip."""
    if not CLIP.bag.is_dir():
        pytest.skip(f'the shipped bag {CLIP.bag} is missing')
    return benchmark_speed.profile(CLIP, 1)


@pytest.fixture(scope='module')
def shown(profile):
    """Six seconds of memory."""
    return benchmark_speed.memory(CLIP, profile.motion, 0.1)


@pytest.fixture
def here(monkeypatch, profile, shown):
    """Parts that take their runs over the recording from the fixtures: (what ran, its recording, variables)."""
    runs = []

    def command(recording, cores=1, **variables):
        runs.append((f'command on {cores}', recording, variables))
        return benchmark_speed.Command(0.5, 0.4, 200.0, 'compiling, which takes a minute\nsome poses')

    def work_here(work, *args, threads=1):
        if work is benchmark_speed.profile:
            runs.append(('profile', args[0], threads))
            return replace(profile, threads=threads)
        return shown if work is benchmark_speed.memory else work(*args)

    monkeypatch.setattr(benchmark_speed, 'replay_command', command)
    monkeypatch.setattr(benchmark_parts, 'in_child', work_here)
    monkeypatch.setattr(benchmark_parts, 'Sizes', lambda: FEW)
    return runs


def test_a_stage_entered_twice_adds_up_and_frames_stay_apart():
    watch = stages.Stopwatch()
    for wall in (1.0, 2.0):
        watch.add('read', stages.Cost(wall, 0.5))
    watch.end_frame()
    with watch.stage('decode'):
        pass
    watch.end_frame()
    assert watch.frames[0] == {'read': stages.Cost(3.0, 1.0)}
    assert list(watch.frames[1]) == ['decode'] and watch.frames[1]['decode'].wall >= 0.0


def test_stages_are_told_in_the_order_of_the_pipeline_with_their_quantiles():
    frames = [{'newer': stages.Cost(1.0, float('nan')), 'total': stages.Cost(1e-3 * k, 2e-3 * k)} for k in range(101)]
    frames.append({'read': stages.Cost(1.0, 1.0)})
    read, total, newer = stages.stages_of(frames)
    assert [s.name for s in (read, total, newer)] == ['read', 'total', 'newer']
    assert (read.frames, total.frames) == (1, 101)
    assert total.wall_ms == pytest.approx({'p50': 50.0, 'p95': 95.0, 'p99': 99.0, 'max': 100.0, 'mean': 50.0})
    assert total.cpu_ms == pytest.approx({name: 2.0 * ms for name, ms in total.wall_ms.items()})
    rows = stages.stages_table([read, total, newer]).splitlines()
    assert rows[3] == '| total | 101 | 50.00 | 95.00 | 99.00 | 100.00 | 100.00 | 190.00 | 198.00 | 200.00 | 100.00 |'
    assert rows[4].endswith('1000.00 | – | – | – | – | – |')


def test_costs_of_the_kernel_and_their_median():
    assert stages.median([stages.Cost(3.0, 1.0), stages.Cost(1.0, 7.0), stages.Cost(2.0, 2.0)]) == (2.0, 2.0)
    assert all(value > 0.0 for value in stages.kernel_median(1))


def test_work_is_compared_with_the_kernel_before_and_after_it(monkeypatch):
    costs = [stages.Cost(1.0, 3.0), stages.Cost(3.0, 5.0)]
    monkeypatch.setattr(stages, 'kernel_median', lambda repeats: costs.pop(0))
    assert stages.beside_kernel(lambda: len(costs)) == (1, stages.Cost(2.0, 4.0))


def test_a_replay_is_timed_by_stage_and_leaves_its_motion(profile):
    assert len(profile.frames) == 45 and profile.resets == 0 and len(profile.kernel) == 1
    assert profile.seconds == pytest.approx(2.2)
    for frame in profile.frames:
        assert {'read', 'decode', 'track', 'total', 'publish', 'front end: track', 'front end: detect'} <= frame.keys()
        assert np.isfinite([cost.cpu for name, cost in frame.items() if 'front end' not in name]).all()
        assert frame['total'].wall >= frame['track'].wall
    assert {'optimise', 'marginalise'} <= profile.frames[-1].keys()
    motion = profile.motion
    assert motion.T_WB.shape[1:] == (4, 4) and len(motion.t_ns) == len(motion.v_W) > 20
    assert np.linalg.norm(motion.gyro_bias) < 0.2 and (np.diff(motion.t_ns) == 50_000_000).all()


def test_memory_is_told_by_its_growth_after_the_warm_up():
    t = np.arange(0.0, 1801.0, 5.0)
    rss = np.where(t < 300.0, 100.0, 200.0 + 0.01 * (t - 300.0))
    found = memory.Memory(tuple(t), tuple(rss), (0,) * len(t), 36_000, 1, 600.0, 12.0)
    grown = memory.growth_of(found, 300.0)
    assert grown.warm_mib == pytest.approx(200.0) and grown.per_10_min_mib == pytest.approx(6.0)
    assert grown.per_10_min_percent == pytest.approx(3.0)
    assert '| the same, % | +3.00 |' in memory.memory_section(found, 300.0, 'memory.png')
    assert memory.growth_of(found, 1800.0) is None
    held = np.ones(4_000_000)
    assert memory.resident_mib() > held.nbytes / memory.MIB
    assert memory.resident_mib(os.getpid()) == pytest.approx(memory.resident_mib(), rel=0.05)


def test_memory_is_sampled_while_the_recording_goes_to_and_fro(shown):
    assert shown.t_s == pytest.approx((0.0, 5.0), abs=0.1) and len(shown.lines) == len(shown.rss_mib) == 2
    assert shown.frames > 80 and shown.resets == 0 and shown.recording_mib > 0.1


def test_the_map_of_the_growth_has_as_many_lines_as_it_says():
    line_map, lines = LineMap(Mapping()), growth.Grid(70)
    for count in (10, 60):
        lines.fill(line_map, count)
    kept = line_map.segments()
    np.testing.assert_array_equal(kept.ids, np.arange(70))
    np.testing.assert_allclose(np.linalg.norm(kept.ends[:, 1] - kept.ends[:, 0], axis=1), growth.LENGTH_M, atol=1e-6)
    assert len(np.unique(kept.ends[:, 0].round(3), axis=0)) == 70


def test_curves_keep_sizes_and_stages_together(tmp_path):
    found = growth.curve('points', (1, 2), [{'a': 1.0}, {'a': 2.0, 'b': 3.0}])
    assert found.sizes == (1, 2) and found.stages_ms['a'] == (1.0, 2.0)
    assert np.isnan(found.stages_ms['b'][0]) and found.stages_ms['b'][1] == 3.0
    growth.plot(tmp_path / 'growth.png', [found, found])
    assert (tmp_path / 'growth.png').read_bytes().startswith(b'\x89PNG')
    assert '| b, ms | – | 3.00 |' in growth.growth_section([found], 'growth.png')


def test_growth_is_told_as_of_a_machine_of_one_speed(monkeypatch):
    monkeypatch.setattr(growth, 'beside_kernel', lambda work: (work(), stages.Cost(1.0, 2.0 * growth.NOMINAL_S)))
    assert growth.beside(lambda: {'optimise': 8.0}) == {'optimise': 4.0}


def test_a_simulated_run_that_cannot_start_is_told():
    with pytest.raises(ValueError, match='with 0 points and 5 lines did not start in 2 s'):
        growth.estimator_ms(0, 5, Estimator(), 2.0)


def test_thread_times_are_told_by_share():
    before = {(7, 'python3.11'): 100, (8, 'python3.11'): 50}
    after = {(7, 'python3.11'): 120, (8, 'python3.11'): 150, (9, 'dds.shm.62661'): 10, (10, 'dds.udp'): 2,
             (11, 'dds.ev'): 3}
    shares = live.thread_shares(before, after, 7, 10.0)
    assert shares == pytest.approx({'python 1': 0.1, 'executor': 0.02, 'dds.shm 1': 0.01, 'others': 0.005})
    ticks = live.thread_ticks(os.getpid())
    assert (os.getpid(), next(name for thread, name in ticks if thread == os.getpid())) in ticks
    assert abs(sum(ticks.values()) * live.TICK_S - time.process_time()) < 0.2 * time.process_time() + 0.5


def test_the_live_section_tells_of_a_node_that_gave_no_pose():
    silent = live.Live(1.0, 20.0, 5.0, 100, 3.0, (), {'image too many': 4}, 0, 'initialising', {'executor': 0.1},
                       (100.0, 101.0))
    text = live.live_section([silent, replace(silent, rate_hz=60.0, ages_ms=(10.0, 20.0, 30.0))],
                             [live.MessageCost('image decoded', 1000.0, 20.0)])
    assert '| 20 Hz | 100 | 0 | – | – | – | – | – | 4 x image too many | 0 | 3.0 | 100 to 101 |' in text
    assert '| 60 Hz | 100 | 3 | 20.0 |' in text and '| image decoded | 1000 | 20 | 2.0 |' in text


def test_the_reference_marks_what_became_slower(tmp_path):
    path = tmp_path / 'reference.json'
    assert read_references(path) == {} and 'no such figures' in comparison({'live: age': 1.0}, {})
    old = {'frames: total': 1.0, 'frames: gone': 1.0, 'live: age': 2.0}
    write_reference(path, 'a', old)
    assert read_references(path) == {'a': old}
    now = {'frames: total': 1.31, 'live: age': 2.0, 'live: new': 1.0}
    assert ratios(now, old) == pytest.approx({'frames: total': 1.31, 'live: age': 1.0})
    marked = [row for row in comparison(now, old).splitlines() if 'slower' in row]
    assert marked == ['| frames: total | 1.31 | slower than the reference |']
    write_reference(path, 'a', {'live: age': 3.0})
    write_reference(path, 'b', {'live: age': 4.0})
    assert read_references(path) == {'a': {'frames: total': 1.0, 'frames: gone': 1.0, 'live: age': 3.0},
                                     'b': {'live: age': 4.0}}
    assert in_kernels('live', {'age': 0.2}, 0.05) == pytest.approx({'live: age': 4.0})
    for text in ('[1]', '{"a": 1}', '{'):
        path.write_text(text)
        with pytest.raises(ValueError, match='is not a reference'):
            read_references(path)


def test_children_have_the_cores_and_threads_they_are_given():
    before = os.sched_getaffinity(0), dict(os.environ)
    with surroundings(1, SOME_WORD='x'):
        assert len(os.sched_getaffinity(0)) == 1
        assert os.environ['OPENBLAS_NUM_THREADS'] == '1' and os.environ['SOME_WORD'] == 'x'
    assert (os.sched_getaffinity(0), dict(os.environ)) == before
    assert in_child(os.getenv, 'OMP_NUM_THREADS', threads=2) == '2'
    assert len(in_child(os.sched_getaffinity, 0)) == 1


def test_a_tape_is_the_recording_on_the_clock_of_the_imu():
    with opened(CLIP) as source:
        tape = Tape.of(replace(source, calibration=replace(source.calibration, time_offset=0.01)))
    with opened(replace(CLIP, resize=0.5)) as source:
        assert source.frame(tape.images[0]).image.shape == (240, 376)
        assert tape.frames_ns[0] - source.frame(tape.images[0]).t_ns == 10_000_000
    assert len(tape.images) == len(tape.frames_ns) >= 44 and (np.diff(tape.imu.t_ns) > 0).all()


def test_the_command_is_run_as_a_user_would():
    command = benchmark_speed.replay_command(replace(CLIP, duration_s=0.1))
    assert 'frames' in command.log and command.wall_s > 0.0 < command.cpu_s and command.peak_mib > 50.0
    with pytest.raises(ValueError, match='does not exist'):
        benchmark_speed.replay_command(replace(CLIP, bag=CLIP.bag / 'nowhere'))


def test_parts_go_into_json_markdown_plots_and_reference(tmp_path, here):
    page, reference = tmp_path / 'page.md', tmp_path / 'reference.json'
    words = ['benchmark', 'speed', '--duration', CLIP.duration_s, '--output', tmp_path / 'out', '--markdown', page,
             '--figures', tmp_path / 'plots', '--reference', reference,
             '--parts', 'frames', 'startup', 'memory', 'growth']
    code, out, err = line_slam(*words, '--update-reference')
    assert code == 0 and 'The reference has no such figures' in out, err
    for kind, sign in {'frames': '| optimise |', 'startup': '| filled | 0.50 | 0.40 |', 'memory': '](plots/memory.png)',
                       'growth': '| lines in the map | 30 | 60 |'}.items():
        section = page.read_text().partition(f'<!-- benchmark speed, {kind}:')[2].partition('<!-- end')[0]
        assert sign in section, kind
        assert json.loads((tmp_path / 'out' / f'{kind}.json').read_text())
    assert 'compiling, which takes a minute' in page.read_text()
    assert {file.name for file in (tmp_path / 'plots').iterdir()} == {'memory.png', 'growth.png'}
    figures = json.loads(reference.read_text())[CLIP.name()]
    assert {name.partition(':')[0] for name in figures} == {'frames', 'startup', 'memory', 'growth'}
    assert all(value >= 0.0 for value in figures.values())
    started = f'command on {len(os.sched_getaffinity(0))}'
    caches = [found['NUMBA_CACHE_DIR'] for what, clip, found in here if what == started and clip.duration_s == 0.2]
    assert len(caches) == 4 and len(set(caches)) == 1
    clips = [(clip.settings, clip.resize, threads) for what, clip, threads in here if what == 'profile']
    assert clips == [((), 1.0, 1), ((), 1.0, 2), (('points.max_count=50',), 1.0, 1), (('lines.max_count=20',), 1.0, 1),
                     ((), 0.5, 1)]


def test_a_second_run_is_compared_with_the_first(tmp_path, here):
    reference = tmp_path / 'reference.json'
    name = CLIP.name()
    assert name == '401 images of 752x480, 2.2 s of it'
    old = {name: {'frames: one thread, total, CPU mean': 1e-9}}
    reference.write_text(json.dumps(old))
    code, out, _ = line_slam('benchmark', 'speed', '--duration', CLIP.duration_s, '--output', tmp_path, '--parts',
                             'frames', '--reference', reference)
    assert code == 0 and 'total, CPU mean' in out and 'slower than the reference' in out
    assert (tmp_path / 'comparison.md').read_text() in out
    assert json.loads(reference.read_text()) == old


def test_a_recording_without_a_whole_motion_is_not_shown_backwards(monkeypatch, profile, tmp_path):
    lost = replace(profile, resets=1)
    monkeypatch.setattr(benchmark_parts, 'in_child', lambda work, *args, threads=1: lost)
    parts = benchmark_parts.Parts(CLIP, tmp_path, str)
    with pytest.raises(ValueError, match='tracked without a reset'):
        parts.memory()


def test_a_node_is_timed_over_dds(profile):
    pytest.importorskip('rclpy')
    benchmark_live = benchmark_parts.live_module()
    run = benchmark_live.live(CLIP, profile.motion, 3.0)
    assert 0 <= len(profile.motion.t_ns) - run.images <= 1 and run.rate_hz == pytest.approx(60.0)
    assert run.seconds >= (run.images - 1) / 60.0 - 0.05 and run.ready_after_s > 0.0
    assert run.status and run.threads['executor'] >= 0.0 and min(run.rss_mib) > 50.0
    assert len(run.ages_ms) + sum(run.drops.values()) <= run.images + 1


def test_messages_are_timed_one_by_one(ros_domain):
    pytest.importorskip('rclpy')
    costs = {cost.what: cost for cost in in_child(benchmark_parts.live_module().message_costs, CLIP)}
    assert all(cost.microseconds > 0.0 for cost in costs.values())
    assert costs['image decoded'].rate_hz == pytest.approx(20.0)
    assert costs['IMU sample read'].rate_hz == pytest.approx(200.0)
    assert sum(cost.rate_hz == 0.0 for cost in costs.values()) == 2


def test_without_ros_the_live_part_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setattr(benchmark_parts, 'import_module', lambda name: (_ for _ in ()).throw(ImportError('rclpy')))
    code, _, err = line_slam('benchmark', 'speed', '--parts', 'live', '--output', tmp_path)
    assert code == 2 and 'needs ROS 2 (rclpy)' in err
