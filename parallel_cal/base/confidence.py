"""The significance level of all tests and intervals."""

SIGNIFICANCE_LEVEL = 0.01  # p-value; an interval holds the other 99 %
# A normally distributed number lies outside +-2.5758 sigma with this probability.
SIGMAS_AT_SIGNIFICANCE_LEVEL = 2.5758
