"""Where stations and their slots stand when a configuration does not list them."""

import math

INSET = 0.05  # of the shorter side: a docked robot is inside the arena


def perimeter_docks(bounds: list[list[float]], n: int) -> list[list[float]]:
    """``n`` stations evenly along the walls of the arena's floor, from the middle of the lower one, counter-clockwise.

    Args:
        bounds: ``[low, high]`` per axis, m.
        n: number of stations.

    Returns:
        ``n`` rows ``[x, y]``, m.
    """
    (x0, x1), (y0, y1) = bounds[:2]
    inset = INSET * min(x1 - x0, y1 - y0)
    x0, x1, y0, y1 = x0 + inset, x1 - inset, y0 + inset, y1 - inset
    width, height = x1 - x0, y1 - y0
    corners = [(0.0, x0, y0), (width, x1, y0), (width + height, x1, y1), (2 * width + height, x0, y1)]
    directions = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    length = 2 * (width + height)
    rows = []
    for k in range(n):
        s = (width / 2 + k * length / n) % length
        side = max(index for index, corner in enumerate(corners) if corner[0] <= s)
        (start, x, y), (dx, dy) = corners[side], directions[side]
        rows.append([x + dx * (s - start), y + dy * (s - start)])
    return rows


def slot_ring(station: list[float], n: int, radius: float) -> list[list[float]]:
    """``n`` slots evenly on a horizontal ring around a station, rows of as many coordinates as the station's, m."""
    angles = [2 * math.pi * k / n for k in range(n)]
    return [[station[0] + radius * math.cos(a), station[1] + radius * math.sin(a), *station[2:]] for a in angles]
