"""The colours of every figure: Okabe and Ito's, which every eye tells apart, and a quiet grey."""

QUIET, BAND = "#8a94a3", "rgba(138,148,163,0.3)"
ACCENT, WARNING = "#3b7dd8", "#d55e00"
MEASURED, PATTERN = "#0072b2", "#d55e00"  # a mean, what an effect would show
