"""The one level at which anything is called more than chance."""

SIGNIFICANCE_LEVEL = 0.01  # p-value of what is significant; a band holds the other 99 %
SIGMAS_AT_SIGNIFICANCE_LEVEL = (
    2.5758  # of a normal number: beyond, on either side, lies half of that chance
)
