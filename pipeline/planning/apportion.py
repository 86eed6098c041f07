"""Division of a whole number in proportion to weights."""

from collections.abc import Sequence


def apportion(total: int, weights: Sequence[float], least: int = 0) -> list[int]:
    """Divide a number in proportion to weights, by largest remainders; of equal remainders, the first are larger.

    Args:
        total: the number to divide, at least ``least`` for each weight.
        weights: weights, not all 0.
        least: smallest part.
    """
    sum_of_weights = sum(weights)
    exact = [total * weight / sum_of_weights for weight in weights]
    parts = [max(least, int(part)) for part in exact]
    places = range(len(parts))
    while sum(parts) < total:
        parts[max(places, key=lambda place: exact[place] - parts[place])] += 1
    while sum(parts) > total:
        parts[max(places, key=lambda place: (parts[place] > least, parts[place] - exact[place]))] -= 1
    return parts
