"""What a running node did: age of its poses, drops, CPU time of its threads."""
from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from line_slam_ros.benchmark.sections import number, table
from line_slam_ros.benchmark.speed_stages import QUANTILES, quantiles

SMALL_SHARE = 0.005  # threads that use less of a core are told together
TICK_S = 1.0 / os.sysconf('SC_CLK_TCK')  # of the CPU times in /proc

EXPLANATION = """\
`line_slam_node` in a process of its own, the player in another, DDS on this machine; images and inertial data are
stamped with the wall clock as they are sent, and the age of a pose is the wall clock minus its stamp when the player
receives it. Three times as fast means the same frames with stamps and wall time three times as dense and the inertial
data of a body that moves that way: angular velocities times three, accelerations (without gravity) times nine, noise
likewise, interpolated to the recorded rate (`benchmark/speed_motion.py`)."""


@dataclass(frozen=True, slots=True)
class Live:
    """One run of the node."""

    speed: float  # times the recorded one
    rate_hz: float  # of the images
    seconds: float  # on the wall
    images: int  # sent
    ready_after_s: float  # from the start of the process until it subscribes
    ages_ms: tuple[float, ...]  # of each pose, as they came
    drops: dict[str, int]
    resets: int
    status: str  # what it said of itself last
    threads: dict[str, float]  # share of a core while images came
    rss_mib: tuple[float, float]  # before the first image and after the last


@dataclass(frozen=True, slots=True)
class MessageCost:
    """Of one kind of message, on the node's side."""

    what: str
    microseconds: float
    rate_hz: float  # at the recorded speed; 0: now and then


def thread_ticks(pid: int) -> dict[tuple[int, str], int]:
    """(thread id, its name) -> CPU time in ticks of a process (Linux)."""
    ticks = {}
    for task in Path(f'/proc/{pid}/task').iterdir():
        name, _, fields = (task / 'stat').read_text(encoding='utf-8').partition('(')[2].rpartition(')')
        user, system = fields.split()[11:13]
        ticks[int(task.name), name] = int(user) + int(system)
    return ticks


def thread_shares(before: Mapping[tuple[int, str], int], after: Mapping[tuple[int, str], int], pid: int,
                  seconds: float) -> dict[str, float]:
    """Share of a core by thread, the busiest first; the main thread is the executor's, small ones are summed up."""
    used = {who: (ticks - before.get(who, 0)) * TICK_S / seconds for who, ticks in after.items()}
    shares, counts = {}, Counter()
    for (thread, name), share in sorted(used.items(), key=lambda item: -item[1]):
        if thread == pid:
            shares['executor'] = share
        elif share >= SMALL_SHARE:
            plain = name.rstrip('.0123456789')  # without versions and ports
            counts[plain] += 1
            shares[f'{plain} {counts[plain]}'] = share
        else:
            shares['others'] = shares.get('others', 0.0) + share
    return shares


def live_section(runs: Sequence[Live], messages: Sequence[MessageCost]) -> str:
    """Three tables: ages and drops, threads, messages."""
    header = ['images', 'sent', 'poses', *(f'age {q}, ms' for q in QUANTILES), 'age p50 of the last third',
              'dropped', 'resets', 'ready after, s', 'memory, MiB']
    ages = [[_name(run), str(run.images), str(len(run.ages_ms)), *_ages(run), _drops(run), str(run.resets),
             f'{run.ready_after_s:.1f}', '{:.0f} to {:.0f}'.format(*run.rss_mib)] for run in runs]
    names = dict.fromkeys(name for run in runs for name in run.threads)
    threads = [[name, *(number(100.0 * run.threads[name] if name in run.threads else None, '.1f') for run in runs)]
               for name in names]
    costs = [[m.what, f'{m.microseconds:.0f}', number(m.rate_hz or None, '.0f'),
              number(1e-4 * m.microseconds * m.rate_hz or None, '.1f')] for m in messages]
    return '\n\n'.join([
        EXPLANATION, table(header, ages),
        'Threads of the node, % of a core; the busiest is the worker, the executor takes and decodes images:',
        table(['thread', *map(_name, runs)], threads),
        'Messages, measured one by one in another process; share of a core at the recorded speed:',
        table(['message', 'us', 'Hz', '%'], costs)])


def _name(run: Live) -> str:
    return f'{run.rate_hz:.0f} Hz'


def _ages(run: Live) -> list[str]:
    if not run.ages_ms:
        return ['–'] * (len(QUANTILES) + 1)
    found = quantiles(run.ages_ms)
    last = float(np.median(run.ages_ms[-(len(run.ages_ms) // 3) - 1:]))
    return [*(f'{found[q]:.1f}' for q in QUANTILES), f'{last:.1f}']


def _drops(run: Live) -> str:
    return ', '.join(f'{n} x {reason}' for reason, n in run.drops.items()) or '0'
