"""Messages for the human, without flooding: each reason once, then at most every so often in message time."""
from __future__ import annotations


class Notes:
    """Collects sentences; the shell takes the new ones and shows them (log, diagnostics, standard error)."""

    def __init__(self, period_s: float = 10.0) -> None:
        self._period_ns = int(period_s * 1e9)
        self._told: dict[str, int] = {}  # reason -> t_ns
        self._new: list[str] = []

    def tell(self, reason: str, sentence: str, t_ns: int) -> None:
        """Keep the sentence unless the same reason was told less than the period before (or after) t_ns."""
        if reason not in self._told or abs(t_ns - self._told[reason]) >= self._period_ns:
            self._told[reason] = t_ns
            self._new.append(sentence)

    def take(self) -> list[str]:
        """Sentences since the last call."""
        new, self._new = self._new, []
        return new
