"""Segments and the cameras around them: what tests of line geometry look at."""
import numpy as np

from line_slam_ros.geometry.lie import rigid, rigid_inverse, so3_exp, transform_points

FOCAL = 460.0  # px


def looking(eye, target, up=(0.0, 0.0, 1.0)):
    """T_WC of a camera at eye that looks at target."""
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, up) / np.linalg.norm(np.cross(z, up))
    return rigid(np.stack([x, np.cross(z, x), z], axis=1), eye)


def image(p_C):
    return p_C[..., :2] / p_C[..., 2:]


def see(T_WC, a, b, part=(0.0, 1.0)):
    """Exact ends (2, 2) in the image of the part of a segment."""
    return image(transform_points(rigid_inverse(T_WC), np.stack([a + s * np.subtract(b, a) for s in part])))


def views(rng, a, b, count, px=0.0, part=lambda k: (0.0, 1.0), distance=4.0):
    """Poses (N, 4, 4) of cameras in front (-y) of a segment, and what they see of it (N, 2, 2)."""
    centre = np.add(a, b) / 2
    T_WC = np.stack([looking(centre + rng.uniform([-1.5, -distance - 1, -1], [1.5, -distance, 1]), centre)
                     for _ in range(count)])
    ends = np.stack([see(T, a, b, part(k)) for k, T in enumerate(T_WC)])
    return T_WC, ends + rng.normal(size=ends.shape) * px / FOCAL


def clipped(rng):
    """Parts of a segment of which one in six reaches the first end, one in six the second."""
    def part(k):
        s, t = np.sort(rng.uniform(0.05, 0.95, 2))
        return [(0.0, t), (s, 1.0), (s, t), (s, t), (s, t), (s, t)][k % 6]
    return part


def walk(frames):
    """Poses T_WC (F, 4, 4) that look along +z and move across it, in front of the scene."""
    t = np.linspace(0, 1, frames)
    p = np.stack([1.5 * np.sin(4 * t), 0.8 * np.cos(5 * t), 0.5 * t], axis=1)
    return rigid(so3_exp(np.stack([0.1 * np.sin(6 * t), 0.1 * np.cos(4 * t), 0.3 * t], axis=1)), p)


def scene(rng, count):
    """Segments (L, 2, 3) four to seven metres ahead, in all directions."""
    middle = rng.uniform([-2, -1.5, 4], [2, 1.5, 7], (count, 3))
    half = rng.normal(size=(count, 3)) * [0.6, 0.6, 0.3]
    return np.stack([middle - half, middle + half], axis=1)
