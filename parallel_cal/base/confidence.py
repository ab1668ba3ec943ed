"""The significance level of all tests and intervals, when two explanations are equally good, and
probabilities in words."""

SIGNIFICANCE_LEVEL = 0.01  # p-value; an interval holds the other 99 %
# A normally distributed number lies outside +-2.5758 sigma with this probability.
SIGMAS_AT_SIGNIFICANCE_LEVEL = 2.5758
# Of the logarithm of the evidence, three sigmas: what is likelier by less is equally good.
EQUAL_EVIDENCE = 4.5
HIGHEST_PERCENT = 99  # a probability is not stated more closely than its model is right


def format_percent(probability: float) -> str:
    """`84 %`; near certainty as `> 99 %`, near impossibility as `< 1 %`."""
    if probability > HIGHEST_PERCENT / 100:
        return f"> {HIGHEST_PERCENT} %"
    if probability < 1 - HIGHEST_PERCENT / 100:
        return f"< {100 - HIGHEST_PERCENT} %"
    return f"{100 * probability:.0f} %"
