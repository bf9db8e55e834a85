"""The parts of ``line_slam benchmark speed``: each measures, and tells it as JSON, as Markdown and as figures."""
from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

from line_slam_ros.benchmark import speed_growth, speed_live, speed_memory
from line_slam_ros.benchmark.sections import table
from line_slam_ros.benchmark.speed_growth import Curve, Sizes
from line_slam_ros.benchmark.speed_motion import Motion
from line_slam_ros.benchmark.speed_reference import in_kernels
from line_slam_ros.benchmark.speed_stages import Cost, Stage, beside_kernel, median, stages_of, stages_table
from line_slam_ros.cli import benchmark_speed
from line_slam_ros.cli.benchmark_source import Recording, bag_marker_maker, in_child
from line_slam_ros.cli.benchmark_speed import Profile
from line_slam_ros.config import Estimator

THREADS = 1, 2
STARTUP_S = 0.2  # of data
WARM_STARTS = 3
WARM_UP_S = 300.0  # of data, before memory is expected to stay
SPEEDS = 1.0, 3.0  # live
COSTLY = 'track', 'optimise', 'map', 'total'


@dataclass(frozen=True)
class Part:
    """What one of them found."""

    document: dict[str, Any]  # JSON
    section: str  # Markdown
    figures: dict[str, float]  # for the reference; see benchmark/speed_reference.py


class Parts:
    """All of them, over one recording."""

    def __init__(self, recording: Recording, figures: Path, link: Callable[[Path], str], minutes: float = 30.0,
                 sizes: Sizes | None = None) -> None:
        """figures: where plots go; link: how the page calls a file there; minutes: of data, to see memory grow."""
        self._recording, self._figures, self._link = recording, figures, link
        self._minutes, self._sizes = minutes, sizes or Sizes()

    def frames(self) -> Part:
        """Time by stage with one thread and with two, and of the whole command."""
        profiles = [self._profile, *(in_child(benchmark_speed.profile, self._recording, n, threads=n)
                                     for n in THREADS[1:])]
        command, kernel = beside_kernel(partial(benchmark_speed.replay_command, self._recording))
        document, sections, figures = {}, [], {}
        for profile in profiles:
            threads = 'one thread' if profile.threads == 1 else f'{profile.threads} threads'
            stages = stages_of(profile.frames)
            own = median(profile.kernel)
            document[threads] = {'stages': [asdict(s) for s in stages], 'kernel_s': own._asdict()}
            sections.append(f'{threads.capitalize()}, ms (kernel {1e3 * own.wall:.1f} ms wall, {1e3 * own.cpu:.1f} ms '
                            f'CPU):\n\n{stages_table(stages)}')
            figures |= _stage_figures(threads, stages, own)
        seconds = self._profile.seconds
        document['replay command'] = command.used() | {'data_s': seconds, 'kernel_s': kernel._asdict()}
        figures |= in_kernels('frames', {'replay command, wall': command.wall_s}, kernel.wall)
        figures |= in_kernels('frames', {'replay command, CPU': command.cpu_s}, kernel.cpu)
        summary = table(['', ''], [
            *_summary(stages_of(self._profile.frames)),
            ['`line_slam replay` on one core, start and figure included, s', f'{command.wall_s:.1f}'],
            ['of it CPU time, s', f'{command.cpu_s:.1f}'],
            ['data, s (times real time)', f'{seconds:.1f} ({seconds / command.wall_s:.1f})'],
            ['most memory of that command, MiB', f'{command.peak_mib:.0f}']])
        what = f'{self._recording.name()}.\n\n{FRAMES}'
        return Part(document, '\n\n'.join([what, summary, *sections]), figures)

    def startup(self) -> Part:
        """From the start of the process, on all cores; the first with an empty cache fills it for the others."""
        cores = len(os.sched_getaffinity(0))
        clip = replace(self._recording, duration_s=STARTUP_S)
        with TemporaryDirectory() as cache:
            start = partial(benchmark_speed.replay_command, clip, cores, NUMBA_CACHE_DIR=cache)
            (cold, *warm), kernel = beside_kernel(lambda: [start() for _ in range(1 + WARM_STARTS)])
        typical = sorted(warm, key=lambda run: run.wall_s)[len(warm) // 2]
        document = {'cold': cold.used(), 'warm': [run.used() for run in warm], 'kernel_s': kernel._asdict()}
        figures = in_kernels('startup', {'cold, CPU': cold.cpu_s, 'warm, CPU': typical.cpu_s}, kernel.cpu)
        figures |= in_kernels('startup', {'cold, wall': cold.wall_s, 'warm, wall': typical.wall_s}, kernel.wall)
        header = ['cache of compiled code', f's, {cores} cores', 'CPU time']
        rows = [['empty', f'{cold.wall_s:.1f}', f'{cold.cpu_s:.1f}'],
                ['filled', f'{typical.wall_s:.2f}', f'{typical.cpu_s:.2f}']]
        told = next((line for line in cold.log.splitlines() if 'compil' in line.lower()), '')
        said = f'With the empty cache it says: "{told}"' if told else 'It does not say that it compiles.'
        return Part(document, f'{STARTUP}\n\n{table(header, rows)}\n\n{said}', figures)

    def memory(self) -> Part:
        """Resident memory, the recording shown to and fro."""
        memory = in_child(benchmark_speed.memory, self._recording, self._motion, self._minutes)
        figure = self._figures / 'memory.png'
        speed_memory.plot(figure, memory)
        growth = speed_memory.growth_of(memory, WARM_UP_S)
        figures = {'memory: most, MiB': max(memory.rss_mib)}
        return Part(asdict(memory) | {'growth': growth and asdict(growth)},
                    speed_memory.memory_section(memory, WARM_UP_S, self._link(figure)), figures)

    def growth(self) -> Part:
        """Stages against sizes."""
        curves = self._curves()
        figure = self._figures / 'growth.png'
        speed_growth.plot(figure, curves)
        largest = {f'{stage}, {c.what} {c.sizes[-1]:g}': 1e-3 * values[-1] for c in curves
                   for stage, values in c.stages_ms.items()}
        return Part({'curves': [asdict(c) for c in curves]}, speed_growth.growth_section(curves, self._link(figure)),
                    in_kernels('growth', largest, speed_growth.NOMINAL_S))

    def live(self) -> Part:
        """A node over DDS, as recorded and faster."""
        benchmark_live = live_module()
        motion = self._motion
        runs, kernel = beside_kernel(lambda: [benchmark_live.live(self._recording, motion, x) for x in SPEEDS])
        with TemporaryDirectory() as scratch, benchmark_live.ros_surroundings(Path(scratch)):
            messages = in_child(benchmark_live.message_costs, self._recording)
        ages = {f'age p50 at {run.rate_hz:.0f} Hz': 1e-3 * sorted(run.ages_ms)[len(run.ages_ms) // 2]
                for run in runs if run.ages_ms}
        return Part({'runs': [asdict(r) for r in runs], 'messages': [asdict(m) for m in messages],
                     'kernel_s': kernel._asdict()}, speed_live.live_section(runs, messages),
                    in_kernels('live', ages, kernel.wall))

    @cached_property
    def _profile(self) -> Profile:
        """With one thread."""
        return in_child(benchmark_speed.profile, self._recording, 1)

    @property
    def _motion(self) -> Motion:
        """ValueError if the recording is not tracked from its start to its end."""
        profile = self._profile
        if profile.motion is None or profile.resets:
            raise ValueError(f'{self._recording.bag} has to be tracked without a reset to be shown faster or backwards')
        return profile.motion

    def _curves(self) -> list[Curve]:
        return [*in_child(estimator_curves, self._sizes), *self._recorded_curves(), in_child(map_curve, self._sizes)]

    def _recorded_curves(self) -> Iterator[Curve]:
        """Stages of the recording against its limits on features and against its size."""
        clip, sizes = replace(self._recording, duration_s=self._sizes.clip_s), self._sizes
        for name, counts in (('points.max_count', sizes.corners), ('lines.max_count', sizes.segments)):
            clips = [replace(clip, settings=(*clip.settings, f'{name}={count}')) for count in counts]
            yield speed_growth.curve(name, counts, list(map(_stage_means, clips)))
        clips = [replace(clip, resize=factor) for factor in sizes.image]
        yield speed_growth.curve('image width, times the recorded', sizes.image, list(map(_stage_means, clips)))


def live_module() -> ModuleType:
    """What measures the live node. ValueError where ROS is not installed."""
    try:
        return import_module('line_slam_ros.cli.benchmark_live')
    except ImportError as error:
        raise ValueError(f'the part live needs ROS 2 ({error}); leave it out, or: '
                         'pip install "line_slam_ros[ros]"') from None


def estimator_curves(sizes: Sizes) -> list[Curve]:
    return list(speed_growth.estimator_curves(sizes, Estimator()))


def _stage_means(clip: Recording) -> dict[str, float]:
    """Nominal mean CPU time, ms, of the method and what it spends most on."""
    found = in_child(benchmark_speed.profile, clip, 1)
    means = {s.name: s.cpu_ms['mean'] for s in stages_of(found.frames) if s.name in COSTLY}
    return speed_growth.nominal(means, median(found.kernel).cpu)


def map_curve(sizes: Sizes) -> Curve:
    """Collected and made a message."""
    make = bag_marker_maker()
    return speed_growth.map_curve(sizes.map, lambda ends: make(0, ends))


def _summary(stages: list[Stage]) -> list[list[str]]:
    """Of the profile with one thread."""
    by_name = {s.name: s for s in stages}
    rest = sum(by_name[name].cpu_ms['mean'] for name in ('read', 'total', 'publish'))
    total = by_name['total']
    return [['CPU time per frame, mean, of the method (`total`), ms', f'{total.cpu_ms["mean"]:.1f}'],
            ['the same with reading and publishing, without decoding of images, ms', f'{rest:.1f}'],
            ['wall time per frame of the method, 99 %, ms', f'{total.wall_ms["p99"]:.1f}']]


def _stage_figures(threads: str, stages: list[Stage], kernel: Cost) -> dict[str, float]:
    """Mean CPU times (wall where it is not known), and quantiles of the wall time of a frame."""
    figures = {}
    for s in stages:
        clock, ms, own = ('CPU', s.cpu_ms, kernel.cpu) if s.cpu_ms else ('wall', s.wall_ms, kernel.wall)
        figures |= in_kernels('frames', {f'{threads}, {s.name}, {clock} mean': 1e-3 * ms['mean']}, own)
        if s.name == 'total':
            quantiles = {f'{threads}, total, wall {q}': 1e-3 * s.wall_ms[q] for q in ('p50', 'p99')}
            figures |= in_kernels('frames', quantiles, kernel.wall)
    return figures


FRAMES = """\
`read` is all that comes from the bag with a frame, decoding of the image apart; `publish` makes, serialises and writes
(into an MCAP file) what the node would publish; `total` is the method, of which `track` (the front end), `initialise`,
`optimise`, `map` (keyframes only) and `marginalise` are parts. Tracked lines sample the image as received through a
table of the lens; only to look for new ones it is undistorted, at half the size, within `front end: detect`. CPU time
is that of all threads. One thread has one core, two have two; only OpenCV and BLAS use them."""
STARTUP = f"""\
From the start of the process `line_slam replay` to its end over the first {STARTUP_S:g} s of the recording, which is a
little more than to the first processed frame."""
