"""The significance level of all tests and intervals, and when two explanations are equally good."""

SIGNIFICANCE_LEVEL = 0.01  # p-value; an interval holds the other 99 %
# A normally distributed number lies outside +-2.5758 sigma with this probability.
SIGMAS_AT_SIGNIFICANCE_LEVEL = 2.5758
# Of the logarithm of the evidence, three sigmas: what is likelier by less is equally good.
EQUAL_EVIDENCE = 4.5
