"""What the optimiser works on: states of the sliding window, their inertial links, landmark tables, the rig, the prior.

Structure of arrays, allocated once; slot 0 is the oldest state, slot n - 1 the newest. The rig is how camera and IMU
belong together: the camera's pose in the body, and by how much an image was taken later than its stamp says. With it
goes what else all states share, the lean of upright lines. These rows of the equations come first, then those of the
slots (state_row).
"""
from __future__ import annotations

import numpy as np

from line_slam_ros.estimation.imu_noise import BANDS, roughness, white
from line_slam_ros.estimation.noise import Noise
from line_slam_ros.geometry.imu import chained, preintegrate
from line_slam_ros.geometry.lie_kernels import log_so3, multiply_transposed
from line_slam_ros.geometry.line_forms import VALUES
from line_slam_ros.geometry.small_systems import factor
from line_slam_ros.kernel_cache import kernel
from line_slam_ros.types import F64, I64, ImuNoise, Samples

REST_S = 2.0  # longer at rest, the accelerometer only ties tilt and bias ever tighter: too stiff to solve, nothing new
REST_SAMPLES = 1000  # inertial samples of a link between states at rest beyond which they are averaged
POOLED_S = 0.5  # of samples that tell the noise of a link
LEAST_WALK = 1e-6  # rad/s^2, m/s^3 per root Hz: less changes nothing in an hour, but is too stiff to solve
STATE = 15  # [rotation, position, velocity, gyro bias, accelerometer bias]
POSE = 6  # the part of a state that a camera sees
RIG = 9  # what all states share: [rotation and position of the camera in the body, time offset, lean of uprights]
DELAY, LEAN = 6, 7  # where the last two begin


@kernel
def state_row(slot):
    """First row of a slot's state in the equations."""
    return RIG + STATE * slot


@kernel
def state_difference(n, R, p, v, b, R0, p0, v0, b0, delta):
    """Fill the rows of the states of delta with present state minus first estimate, rotation as Log(R0' R)."""
    E = np.empty((3, 3))
    for k in range(n):
        o = state_row(k)
        multiply_transposed(R0[k], R[k], E)
        log_so3(E, delta[o:o + 3])
        for i in range(3):
            delta[o + 3 + i] = p[k, i] - p0[k, i]
            delta[o + 6 + i] = v[k, i] - v0[k, i]
        for i in range(6):
            delta[o + 9 + i] = b[k, i] - b0[k, i]


def rig_difference(R_BC, p_BC, delay, lean, R_given, p_given, delta):
    """delta (9,) = present rig minus the given one, which has no delay, and the lean."""
    E = np.empty((3, 3))
    multiply_transposed(R_given, R_BC, E)
    log_so3(E, delta[:3])
    delta[3:6] = p_BC - p_given
    delta[DELAY] = delay[0]
    delta[LEAN:] = lean


@kernel
def whiten(cov, W):
    """W = L^-1 with L L' = cov, both (9, 9): W' W = cov^-1; NaN when cov is not positive."""
    L = cov.copy()
    for i in range(9):
        L[i, i] += 1e-14  # of a link without noise
    if not factor(L, 9, 0.0):
        W[:] = np.nan
        return
    W[:] = 0.0
    for j in range(9):
        W[j, j] = 1.0 / L[j, j]
        for i in range(j + 1, 9):
            for k in range(j, i):
                W[i, j] -= L[i, k] * W[k, j] / L[i, i]


def averaged(samples: Samples) -> Samples:
    """The same time and means in eleven samples: all that matters of a link at rest."""
    t, gyro, accel = samples
    share = np.diff(t)[:, None] / t[-1]
    means = (np.tile((share * 0.5 * (a[1:] + a[:-1])).sum(axis=0), (11, 1)) for a in (gyro, accel))
    return np.linspace(0.0, t[-1], 11), *means


class LandmarkTable:
    """Landmarks of one kind by row and their observations by (row, slot).

    ``fields`` are extra columns: name -> (trailing shape). Rows are dense: [0, count).
    """

    def __init__(self, rows: int, slots: int, observation: tuple[int, ...], fields: dict[str, tuple[int, ...]]):
        self.count = 0
        self.ids = np.full(rows, -1, np.int64)
        self.seen = np.zeros((rows, slots), np.bool_)
        self.z = np.zeros((rows, slots, *observation))  # normalised image coordinates
        self.sigma = np.ones((rows, slots, 2))  # their standard deviation: as given, times the scale of the track
        self.images = np.ones((rows, slots), np.int64)  # over which an observation is a mean: neighbours.py
        self.scale, self.noise = np.ones(rows), Noise()  # of each track's errors, and what is known of all: noise.py
        self.solved = np.zeros(rows, np.bool_)  # has a 3D estimate and takes part in the optimisation
        self.views = np.zeros(rows, np.int64)  # keyframes that ever saw it, also those that left the window
        self.taken = np.full(rows, -1, np.int64)  # its row when Jacobians were taken last; -1: not there
        # L (rows, d, d), a field of both: L L' is its Hessian, given the poses, at the last anchor (following.py)
        self._columns = ['ids', 'seen', 'z', 'sigma', 'images', 'solved', 'views', 'taken', 'scale', *fields]
        for name, shape in fields.items():
            setattr(self, name, np.zeros((rows, *shape)))

    def observe(self, slot: int, ids: I64, z: F64, sigma: F64) -> None:
        """Write one frame's observations (N, ...) into a slot; unknown ids get new rows while there is room."""
        rows = self.find(ids)
        room = len(self.ids) - self.count
        fresh = np.flatnonzero(rows < 0)[:room]
        rows[fresh] = self.count + np.arange(len(fresh))
        self._clear_rows(self.count, self.count + len(fresh))
        self.ids[rows[fresh]] = ids[fresh]
        self.count += len(fresh)
        used = rows >= 0
        self.seen[rows[used], slot], self.z[rows[used], slot] = True, z[used]
        self.sigma[rows[used], slot], self.images[rows[used], slot] = sigma[used] * self.scale[rows[used], None], 1

    def find(self, ids: I64) -> I64:
        """Rows (N,) of ids, -1 where unknown."""
        if not self.count:
            return np.full(len(ids), -1)
        order = np.argsort(self.ids[:self.count], kind='stable')
        at = np.searchsorted(self.ids[:self.count], ids, sorter=order)
        rows = order[np.minimum(at, self.count - 1)]
        return np.where(self.ids[rows] == ids, rows, -1)

    def _clear_rows(self, first: int, last: int) -> None:
        self.seen[first:last], self.solved[first:last] = False, False
        self.views[first:last], self.taken[first:last], self.scale[first:last] = 0, -1, self.noise.typical

    def learn_noise(self, n: int, pull: F64, weight: F64, unknowns: int) -> None:
        """Bring scales and standard deviations to what the residuals of n states, just optimised, show.

        weight (rows, slots), pull (rows, slots, 2): see landmarks.py; unknowns: numbers of a landmark.
        """
        c = self.count
        scale, weight = self.scale[:c, None], weight[:c, :n]
        told = self.solved[:c, None] & self.seen[:c, :n] & (weight > 0.0)
        per_weight = np.divide(scale, weight, out=np.zeros((c, n)), where=told)[..., None]
        residuals = np.where(told[..., None], pull[:c, :n], 0.0) * per_weight
        ratio = self.noise.learn(residuals, told, unknowns)[:, None] / scale
        scale *= ratio
        self.sigma[:c, :n] *= ratio[..., None]

    def remove_slot(self, slot: int, slots: int) -> None:
        """Forget what a slot saw and close the gap; slots = number of slots in use before."""
        for a in (self.seen, self.z, self.sigma, self.images):
            a[:self.count, slot:slots - 1] = a[:self.count, slot + 1:slots]
        self.seen[:self.count, slots - 1] = False

    def keep(self, mask: np.ndarray) -> None:
        """Drop the rows where mask (count,) is False."""
        if mask.all():
            return
        stays = int(np.argmin(mask))  # rows before the first that goes
        moved = stays + np.flatnonzero(mask[stays:])
        self.count = stays + len(moved)
        for name in self._columns:
            a = getattr(self, name)
            a[stays:self.count] = a[moved]


class Window:
    """States, links, landmarks and prior; knows how to add, drop and shift, not how to optimise."""

    def __init__(self, slots: int, noise: ImuNoise, max_points: int, max_lines: int):
        self.slots, self.noise, self.n = slots, noise, 0
        self.t_ns = np.zeros(slots, np.int64)
        self.R, self.p, self.v, self.b = (np.zeros((slots, *s)) for s in ((3, 3), (3,), (3,), (6,)))
        # first estimates: Jacobians of frozen states are taken here, so that the prior's null space survives
        self.R0, self.p0, self.v0, self.b0 = (np.zeros_like(a) for a in (self.R, self.p, self.v, self.b))
        self.frozen = np.zeros(slots, np.bool_)
        self.still = np.zeros(slots, np.bool_)  # the body did not move: velocity is measured as zero
        # link k: slot k -> k + 1
        self.dt = np.zeros(slots)
        self.dR, self.dp, self.dv = np.zeros((slots, 3, 3)), np.zeros((slots, 3)), np.zeros((slots, 3))
        self.J_b, self.cov, self.W = np.zeros((slots, 9, 6)), np.zeros((slots, 9, 9)), np.zeros((slots, 9, 9))
        self.w_b, self.b_lin = np.zeros((slots, 6)), np.zeros((slots, 6))
        self.power = np.zeros((slots, 2, BANDS, 2))  # of gyro and accelerometer: imu_noise.py
        self.samples: list[Samples] = []  # raw t (s), gyro, accel of each link
        self.rates = np.zeros((slots, 3))  # angular velocity of each state, rad/s, in B
        self.calibrated = np.eye(3), np.zeros(3)  # R_BC, p_BC as given
        self.R_BC, self.p_BC, self.delay = np.eye(3), np.zeros(3), np.zeros(1)  # delay: s, of the image after its stamp
        self.lean = np.zeros(2)  # horizontal part, in W, of where the building's vertical points, rad: uprights.py
        self.rig_sigma = np.zeros(RIG)  # of what was given; what is zero is not estimated
        size = RIG + STATE * slots
        self.prior_H, self.prior_g = np.zeros((size, size)), np.zeros(size)
        self.points = LandmarkTable(max_points, slots, (2,), {'abr': (3,), 'R_WA': (3, 3), 'p_WA': (3,), 'L': (3, 3)})
        self.lines = LandmarkTable(max_lines, slots, (2, 2), {'values': (VALUES,), 'origin': (3,), 'L': (4, 4)})

    def clear(self) -> None:
        """Back to an empty window, of which nothing is known."""
        self.n, self.points.count, self.lines.count = 0, 0, 0
        self.points.noise, self.lines.noise = Noise(), Noise()  # what went astray may have taught anything
        self.samples.clear()
        self.prior_H[:], self.prior_g[:] = 0.0, 0.0
        self.R_BC[:], self.p_BC[:], self.delay[:], self.lean[:] = *self.calibrated, 0.0, 0.0
        free = np.flatnonzero(self.rig_sigma)
        self.prior_H[free, free] = self.rig_sigma[free]**-2.0

    def set_rig(self, R_BC: F64, p_BC: F64, sigma: F64) -> None:
        """The camera in the body as calibrated, and sigma (9,), how far that, the time offset and the lean may be off
        (0: not at all)."""
        self.calibrated, self.rig_sigma = (R_BC.copy(), p_BC.copy()), sigma.copy()
        self.clear()

    @property
    def rows(self) -> int:
        """Number of rows of the equations that are in use: the first ones."""
        return state_row(self.n)

    def delta(self, out: F64) -> F64:
        """out (9 + 15 slots,) = present rig and states minus their first estimates, zero where not in use."""
        out[self.rows:] = 0.0
        state_difference(self.n, self.R, self.p, self.v, self.b, self.R0, self.p0, self.v0, self.b0, out)
        rig_difference(self.R_BC, self.p_BC, self.delay, self.lean, *self.calibrated, out[:RIG])
        return out

    def append(self, t_ns: int, R: F64, p: F64, v: F64, b: F64, samples: Samples | None) -> int:
        """Add the newest state; samples are those since the previous one (None for the first). Returns its slot."""
        k = self.n
        self.t_ns[k], self.R[k], self.p[k], self.v[k], self.b[k] = t_ns, R, p, v, b
        self.frozen[k] = self.still[k] = False
        if k:
            assert samples is not None
            self.samples.append(samples)
            self.integrate(k - 1)
            self.rates[k] = samples[1][-1] - b[:3]
            if k == 1:
                self.rates[0] = samples[1][0] - b[:3]
        self.n += 1
        return k

    def integrate(self, link: int) -> None:
        """(Re)integrate a link's samples about the present bias of its first state."""
        t, gyro, accel = self.samples[link]
        for power, x in zip(self.power[link], (gyro, accel), strict=True):
            roughness(t[-1] / (len(t) - 1), x, power)
        self.b_lin[link], self.dt[link] = self.b[link], t[-1]
        preintegrate(t, gyro, accel, self.b_lin[link, :3], self.b_lin[link, 3:], *self._white_noise(link),
                     self.dR[link], self.dp[link], self.dv[link], self.J_b[link], self.cov[link])
        whiten(self.cov[link], self.W[link])
        if self.dt[link] > REST_S and self.still[link] and self.still[link + 1]:
            self.W[link, 3:] = 0.0  # of lower triangular W, what is left whitens the rotation alone
        self.w_b[link, :3] = 1.0 / (max(self.noise.gyro_walk, LEAST_WALK) * np.sqrt(self.dt[link]))
        self.w_b[link, 3:] = 1.0 / (max(self.noise.accel_walk, LEAST_WALK) * np.sqrt(self.dt[link]))

    def _white_noise(self, link: int) -> tuple[float, float]:
        """Squared densities of gyro and accelerometer: as calibrated, or more if a link's samples show more, with
        those of its neighbours for half a second in all."""
        first = last = link
        while self.dt[first:last + 1].sum() < POOLED_S and last - first < len(self.samples) - 1:
            first, last = max(first - 1, 0), min(last + 1, len(self.samples) - 1)
        gyro, accel = self.power[first:last + 1].sum(axis=0)
        return max(self.noise.gyro_density**2, white(gyro)), max(self.noise.accel_density**2, white(accel))

    def freeze(self, slots: np.ndarray) -> None:
        """Fix the linearisation point of states the prior is about to know."""
        for k in slots:
            if not self.frozen[k]:
                self.frozen[k] = True
                self.R0[k], self.p0[k], self.v0[k], self.b0[k] = self.R[k], self.p[k], self.v[k], self.b[k]

    def recentre_prior(self) -> None:
        """Move every first estimate to the present state and the prior along; rotations to first order."""
        delta = self.delta(np.empty(len(self.prior_g)))
        delta[:RIG] = 0.0
        delta[RIG:self.rows].reshape(-1, STATE)[~self.frozen[:self.n]] = 0.0
        self.prior_g += self.prior_H @ delta
        for first, now in ((self.R0, self.R), (self.p0, self.p), (self.v0, self.v), (self.b0, self.b)):
            first[:self.n] = now[:self.n]

    def unfrozen_to_current(self) -> None:
        """States no prior knows are linearised where they are."""
        free = np.flatnonzero(~self.frozen[:self.n])
        for first, now in ((self.R0, self.R), (self.p0, self.p), (self.v0, self.v), (self.b0, self.b)):
            first[free] = now[free]

    def remove(self, slot: int) -> None:
        """Take a state out and close the gap; the links before and after it become one."""
        n = self.n
        if 0 < slot < n - 1:
            merged = chained(self.samples[slot - 1:slot + 1])
            if len(merged[0]) > REST_SAMPLES and self.still[slot - 1:slot + 2].all():
                merged = averaged(merged)
            self.samples[slot - 1:slot + 1] = [merged]
        elif self.samples:
            del self.samples[0 if slot == 0 else -1]
        for a in (self.t_ns, self.R, self.p, self.v, self.b, self.R0, self.p0, self.v0, self.b0, self.frozen,
                  self.still, self.rates):
            a[slot:n - 1] = a[slot + 1:n]
        for a in (self.dt, self.dR, self.dp, self.dv, self.J_b, self.cov, self.W, self.w_b, self.b_lin,
                  self.power):
            a[slot:n - 2] = a[slot + 1:n - 1]
        for table in (self.points, self.lines):
            table.remove_slot(slot, n)
        self._remove_from_prior(slot)
        self.n = n - 1
        if 0 < slot < n - 1:
            self.integrate(slot - 1)

    def _remove_from_prior(self, slot: int) -> None:
        lo, hi, end = state_row(slot), state_row(slot + 1), self.rows
        H, g = self.prior_H, self.prior_g
        H[lo:end - STATE] = H[hi:end].copy()
        H[:, lo:end - STATE] = H[:, hi:end].copy()
        g[lo:end - STATE] = g[hi:end].copy()
        H[end - STATE:end], H[:, end - STATE:end], g[end - STATE:end] = 0.0, 0.0, 0.0
