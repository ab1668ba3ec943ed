"""The colours of all figures: a grey, and the colour-blind safe palette of Okabe and Ito."""

QUIET, BAND = "#8a94a3", "rgba(138,148,163,0.3)"
ACCENT, WARNING = "#3b7dd8", "#d55e00"
MEASURED, PATTERN = "#0072b2", "#d55e00"  # a measured mean, the pattern of an effect
