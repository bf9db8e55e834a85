"""Structure of arrays whose rows live and die together."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

Self = TypeVar('Self', bound='Rows')


@dataclass
class Rows:
    """Base of dataclasses of arrays that share their first axis."""

    def __len__(self) -> int:
        return len(getattr(self, self.__match_args__[0]))

    def select(self: Self, which: Any) -> Self:
        """The rows that a mask, index array or slice names."""
        return type(self)(*(getattr(self, name)[which] for name in self.__match_args__))

    def extended(self: Self, more: Self) -> Self:
        """These rows, then more."""
        return type(self)(*(np.concatenate([getattr(self, name), getattr(more, name)]) for name in self.__match_args__))
