"""How lines are solved for: form, joint or one by one, start, loss, weights, rule for end points; light to import."""
from __future__ import annotations

from dataclasses import dataclass
from math import inf

from line_slam_ros.types import LineForm, Loss

STARTS = ('two-plane', 'best-parallax', 'svd', 'consensus', 'truth')  # experiment/starts.py
END_RULES = ('shrink', 'median', 'extend', 'quantile', 'vote')  # experiment/ends.py


@dataclass(frozen=True, slots=True)
class Method:
    """One way to solve a LineProblem. ValueError for settings that mean nothing."""

    form: LineForm = LineForm.ORTHONORMAL
    joint: bool = False  # one damping and one verdict for all lines; otherwise each line on its own
    start: str = 'consensus'
    loss: Loss = Loss.L2  # of the last fit; those that find sigma and the views over the gate use Cauchy
    loss_scale: float = 3.0  # standard deviations
    sigma_px: float | None = None  # standard deviation of an observed end across its line; None: from the residuals
    gate: float | None = 20.0  # squared whitened residual of a view that is left out in the end; None: never
    focal: float = 460.0  # px per unit of the normalised image
    use_host: bool = True  # count the view that the form is pinned to
    iterations: int = 200  # at most
    tolerance: float = 1e-12  # relative decrease of the cost at which to stop, 0: never
    min_parallax_deg: float = 1.0  # between the planes that a line is started from
    ends: str = 'vote'
    end_share: float = 0.1  # of the views, beyond an end ('quantile') or confirming it ('vote')

    def __post_init__(self) -> None:
        for name, known in (('start', STARTS), ('ends', END_RULES)):
            if getattr(self, name) not in known:
                raise ValueError(f'{name} must be one of {", ".join(known)}, got {getattr(self, name)!r}')
        for name in ('loss_scale', 'sigma_px', 'gate', 'focal', 'min_parallax_deg'):
            if getattr(self, name) is not None and not 0.0 < getattr(self, name) < inf:
                raise ValueError(f'{name} must be positive and finite, got {getattr(self, name)}')
        if not 0.0 < self.end_share <= 0.5:
            raise ValueError(f'end_share must lie in (0, 0.5], got {self.end_share}')
        if self.iterations < 1:
            raise ValueError(f'at least one iteration is needed, got {self.iterations}')
        if not self.tolerance >= 0.0:
            raise ValueError(f'tolerance must not be negative, got {self.tolerance}')


PRESETS = {
    # Cauchy with scale 1 at 3.2 px, the host's observation left out, every view must have seen the segment
    'authors': Method(joint=True, start='best-parallax', loss=Loss.CAUCHY, loss_scale=1.0, sigma_px=3.2, gate=None,
                      use_host=False, ends='shrink'),
    # wrong views are found and left out, then plain least squares
    'best': Method(),
}
