"""Structure of arrays whose rows live and die together."""
from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

Self = TypeVar('Self', bound='Rows')


@dataclass
class Rows:
    """Base of dataclasses of arrays that share their first axis."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def select(self: Self, which: Any) -> Self:
        """The rows that a mask, index array or slice names."""
        return type(self)(*(getattr(self, f.name)[which] for f in fields(self)))

    def extended(self: Self, more: Self) -> Self:
        """These rows, then more."""
        return type(self)(*(np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(self)))
