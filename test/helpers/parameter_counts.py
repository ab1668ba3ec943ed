"""Number of parameters of a complete model by the formulas of section 3.2 (eqs 3.1-3.4)."""


def serial(R: int, P: int) -> int:
    """Eq. 3.1: R revolute and P prismatic joints, arbitrary base and platform frames."""
    return 4 * R + 2 * P + 6


def single_loop(R: int, P: int, SS: int, E: int) -> int:
    """Eq. 3.2: one loop with SS rods between two balls and E encoders, one arbitrary frame."""
    return 3 * R + P + SS + E + 6


def multi_loop(R: int, P: int, SS: int, E: int, L: int, F: int = 2) -> int:
    """Eq. 3.3: L loops, F arbitrarily located frames."""
    return 3 * R + P + SS + E + 6 * L + 6 * (F - 1)


def planar_or_spherical(R: int, S: int, E: int, L: int, F: int = 2) -> int:
    """Eq. 3.4: L loops in a plane or on a sphere; prismatic joints do not count."""
    return R + S + E + 3 * L + 3 * (F - 1)
