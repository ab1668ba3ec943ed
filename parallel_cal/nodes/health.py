"""The state of a node's streams: rate, loss and latency, in the form of diagnostic_updater."""

from __future__ import annotations

import time
from collections import Counter, deque
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from parallel_cal.nodes.tally import diagnostics
from parallel_cal.recordings.sources import Sources

WINDOW = 10  # s over which rates and shares are computed
MAX_LATENCY_S = 0.1  # s from reception to answer; a warning if one in a hundred takes longer
# Share of messages lost, skipped or refused that causes a warning, and an error.
WARN_SHARE = 1e-3
ERROR_SHARE = 0.1


class Stream:
    """One topic: counts since the start, and for each second of a window."""

    def __init__(self) -> None:
        self.total: Counter[str] = Counter()
        self._last = Counter[str]()
        self._seconds: deque[Counter[str]] = deque(maxlen=WINDOW)
        self._latencies: deque[int] = deque(maxlen=1000 * WINDOW)
        self._sources = Sources()
        self.reason = ""

    def count_received(self, sequence: int | None) -> None:
        """Count a message and, by its sequence number, those lost before it."""
        self.total["received"] += 1
        self._sources.identify(sequence)

    def count_skipped(self, sequence: int | None) -> None:
        """Count a message that was received too late to be answered."""
        self.count_received(sequence)
        self.total["skipped"] += 1

    def count_answered(self, received_ns: int) -> None:
        """Note the latency of a message that is answered now."""
        self._latencies.append(time.time_ns() - received_ns)

    def count_refused(self, reason: str) -> None:
        self.total["refused"] += 1
        self.reason = reason

    def diagnosis(self, name: str, topic: str) -> Any:
        """Return a DiagnosticStatus; call it once a second.

        WARN if more than a thousandth was lost, skipped or refused, ERROR if more than a tenth was.
        """
        self.total["lost"] = self._sources.lost
        self._seconds.append(self.total - self._last)
        self._last = self.total.copy()
        window = sum(self._seconds, Counter[str]())
        seconds, sent = max(len(self._seconds), 1), max(window["received"] + window["lost"], 1)
        ordered = sorted(self._latencies)
        p99 = ordered[int(0.99 * (len(ordered) - 1))] * 1e-9 if ordered else 0.0
        shares = {kind: window[kind] / sent for kind in ("lost", "skipped", "refused")}
        wrong = [f"{share:.2%} {kind}" for kind, share in shares.items() if share > WARN_SHARE]
        wrong += [f"{1e3 * p99:.0f} ms late"] * (p99 > MAX_LATENCY_S)
        level = DiagnosticStatus.WARN if wrong else DiagnosticStatus.OK
        if max(shares.values()) > ERROR_SHARE:
            level = DiagnosticStatus.ERROR
        items = {
            "Events in window": str(window["received"]),
            "Events since startup": str(self.total["received"]),
            "Duration of window (s)": str(seconds),
            "Actual frequency (Hz)": f"{window['received'] / seconds:.1f}",
            "Lost in window": str(window["lost"]),
            "Lost since startup": str(self.total["lost"]),
            "Skipped in window": str(window["skipped"]),
            "Skipped since startup": str(self.total["skipped"]),
            "Refused in window": str(window["refused"]),
            "Refused since startup": str(self.total["refused"]),
            "Last reason": self.reason,
            "Latency p99 (ms)": f"{1e3 * p99:.2f}",
        }
        text = "; ".join(wrong) if wrong else "OK" if window else "no messages"
        return diagnostics(f"{name}: {topic}", level, text, items)
