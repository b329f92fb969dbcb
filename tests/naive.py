"""The obvious slow way of what the package computes fast."""

import itertools
import math

import numpy as np

from drake_safety.learning.change_detector import TIME_CONSTANTS_S


def fusion(beliefs):
    """F with the products as the paper prints them, for a handful of uncertain beliefs."""
    mu = beliefs[:, 2]
    others = np.array([np.prod(np.delete(mu, i)) for i in range(len(mu))])
    divisor = others.sum() - len(mu) * mu.prod()
    masses = (beliefs[:, :2] * ((1 - mu) * others)[:, None]).sum(axis=0) / divisor
    return np.append(masses, (len(mu) - mu.sum()) * mu.prod() / divisor)


def dtw(error, length):
    """Dynamic time warping of all pairs of sequences, cell by cell, (n, n)."""
    n, m = error.shape[:2]
    total, beyond = {(0, 0): np.zeros((n, n))}, np.full((n, n), np.inf)
    for i, j in itertools.product(range(m), repeat=2):
        squared = np.sum((error[:, None, i] - error[:, j]) ** 2, axis=-1)
        before = [total.get(cell, beyond) for cell in ((i, j), (i, j + 1), (i + 1, j))]
        total[i + 1, j + 1] = squared + np.minimum.reduce(before)
    rows = range(n)
    return np.array([[total[length[a], length[b]][a, b] for b in rows] for a in rows])


def charts(detector, motions):
    """Levels and charts after each row of consecutive motions, one after another."""
    charts, levels = np.zeros((6, len(detector.watched))), np.zeros(len(detector.watched))
    seen = []
    for one in motions:
        x, state, repeats = one[:, detector.columns], one[:, detector.watched], 0
        for k in range(len(one)):
            repeats = repeats + 1 if k > 0 and np.array_equal(x[k], x[k - 1]) else 0
            if k > 1:
                z = detector.innovation(x[k - 1], x[k - 2], state[k] - state[k - 1])
                charts = charts.copy()
                for i, memory_s in enumerate(TIME_CONSTANTS_S):
                    weight = min(detector.step_s / memory_s, 1.0)
                    charts[i] += weight * (z - charts[i])
                    charts[i + 3] += weight * (z**2 - 1.0 - charts[i + 3])
                of_charts = np.vstack([np.abs(charts[:3]), charts[3:]]) / detector.limits
                levels = np.maximum(of_charts.max(axis=0), repeats / detector.longest_repeat)
            seen.append((levels, charts))
    return tuple(np.array(each) for each in zip(*seen, strict=True))


def whitened_distances(known, x, plan):
    """Distances of a Novelty by whitening each axis, its variance bounded from below."""
    scale = np.maximum(np.sqrt(np.diag(known.covariance)), 1e-2)
    found = []
    for columns, least, most in (
        (slice(None), 1e-2, np.inf),
        (slice(None), 1e-8, 1e-7),
        (plan, 1e-4, np.inf),
    ):
        unit = scale[columns]
        variance, axes = np.linalg.eigh(known.covariance[columns, columns] / np.outer(unit, unit))
        along = (x - known.mean)[:, columns] / unit @ axes
        squares = (along**2 / np.maximum(variance, least))[:, variance < most]
        found.append(np.sqrt(squares.sum(axis=1)))
    return np.stack(found, axis=1)


def prediction(assessment, x):
    """Belief with causes, probability, margins, novelty and fall probability of one finite input.

    One map, layer, cell, tree and head after another, in double precision.
    """
    maps, grid, logit = assessment.embedding_, assessment.grid_, assessment.base_logit_
    correction, novelty = assessment.correction_, assessment.novelty_
    empty = np.eye(assessment.beliefs_.shape[2])[2]
    belief, clipped, guards = np.zeros(len(empty)), np.clip(x, *maps.input_range.astype(float)), []
    said, margins, hidden = [], [], 0.0
    for k in range(maps.num_members):
        w = {name: array[k].astype(float) for name, array in maps.weights.items()}
        z = clipped
        for i in range(maps.num_layers):
            z = np.maximum(z @ w[f"trunk.{i}.weight"] + w[f"trunk.{i}.bias"], 0.0)
        hidden += z @ correction.hidden[k, :-1] + correction.hidden[k, -1]
        output = z @ w["output.weight"] + w["output.bias"]
        margins.append(output[2:])
        if maps.has_heads:
            h = np.maximum(output[:2] @ w["safety.0.weight"] + w["safety.0.bias"], 0.0)
            said.append(np.clip(h @ w["safety.1.weight"] + w["safety.1.bias"], -8, 8).item())
        weights = cell_weights(grid, output[:2])
        belief += empty * (1.0 - weights.sum()) + weights @ assessment.beliefs_[k]
        guards += [weights @ correction.guard[k]] * bool(weights.any())
    margins = np.mean(margins, axis=0)
    known = novelty.training
    known = known if novelty.feedback is None else known.joined(novelty.feedback)
    distances = whitened_distances(known, x[None], novelty.plan)[0]
    distance = max(distances / novelty.limits[:3])
    low, high = known.least, known.largest
    offset = np.abs(x - (low + high) / 2) / np.maximum((high - low) / 2, 0.05)
    distance = max(distance, offset.max() / novelty.limits[3])
    belief = belief / maps.num_members if distance <= 1.0 else empty
    probability, fall = belief[0], np.nan
    if logit is not None:
        smallest = np.clip(margins.min(), *logit.margin_range)
        heads = [np.mean(said), -smallest / logit.margin_unit]
        if assessment.trees_ is not None:
            heads.append(np.clip(tree_sum(assessment.trees_.arrays, x), -8, 8))
        unsafe = np.clip(logit.offset + np.dot(heads, logit.slopes[: len(heads)]), -8, 8)
        shift = correction.change[0] + np.dot(heads, correction.change[1:])
        shift = np.clip(shift + np.clip(hidden, *correction.hidden_range), -100, 100)
        unsafe += shift * (1.0 - np.mean(guards or [0.0]) if shift < 0.0 else 1.0)
        probability = 1.0 / (1.0 + np.exp(unsafe))
        if assessment.fall_logit_ is not None and len(margins):
            of = assessment.fall_logit_
            terms = np.dot(of.weights, [*margins, unsafe, *x[list(of.columns)]]) + of.offset
            fall = 1.0 / (1.0 + np.exp(-terms))
    if belief[2] > 0.5 * (1.0 + assessment.parameters.initial_uncertainty) - 1e-9:
        probability = 0.0
    return belief, probability, margins, distance, fall


def cell_weights(grid, y):
    """The weight of every cell at a point, (R*R,): bilinear, or one for the cell around it."""
    weights, place = np.zeros((grid.resolution,) * 2), (y + grid.half_width) / grid.cell_length
    if np.all((place >= 0.0) & (place < grid.resolution)):
        for i, j in itertools.product(range(grid.resolution), repeat=2):
            if grid.interpolates:
                u = np.clip(place - 0.5, 0.0, grid.resolution - 1.0)
                weights[i, j] = max(0.0, 1.0 - abs(u[0] - i)) * max(0.0, 1.0 - abs(u[1] - j))
            else:
                weights[i, j] = (i, j) == tuple(place.astype(int))
    return weights.ravel()


def tree_sum(arrays, x):
    """The sum of the leaves that one input reaches, tree by tree and node by node."""
    total, single = 0.0, x.astype(np.float32)
    for tree, leaves in enumerate(arrays["value"].astype(float)):
        excluded = 0
        for feature, threshold, left in zip(
            *(arrays[name][:, tree] for name in ("feature", "threshold", "left")), strict=True
        ):
            if single[feature] > threshold:
                excluded |= int(left)
        total += next(leaf for i, leaf in enumerate(leaves) if not excluded >> i & 1)
    return total


def capital(outcomes, mean, shares, weights, is_above):
    """The capital of bets against a mean, bet by bet: of each share u, and their weighted mean."""
    total = 0.0
    for share, weight in zip(shares, weights, strict=True):
        each = 1.0
        for outcome in outcomes:
            if is_above:
                each *= 1 + share / (1 + mean) * (outcome - mean)
            else:
                each *= 1 - share / (1 - mean) * (outcome - mean)
        total += weight * each
    return total


def in_triangle(p, a, b, c):
    def side(u, w):
        return (w[0] - u[0]) * (p[1] - u[1]) - (w[1] - u[1]) * (p[0] - u[0])

    signs = [side(a, b), side(b, c), side(c, a)]
    return all(s >= 0 for s in signs) or all(s <= 0 for s in signs)


def hull_distance(point, points, samples=2001):
    """Signed distance to a hull without any hull.

    A point is inside when some triangle of the points holds it; the hull's edges are the pairs
    that have all other points on one side.
    """
    n = len(points)
    inside = any(
        in_triangle(point, points[i], points[j], points[k])
        for i in range(n)
        for j in range(i)
        for k in range(j)
    )
    s = np.linspace(0, 1, samples)[:, None]
    nearest = math.inf
    for i in range(n):
        for j in range(n):
            a, b = points[i], points[j]
            cross = (b - a)[0] * (points - a)[:, 1] - (b - a)[1] * (points - a)[:, 0]
            if i != j and np.all(cross >= -1e-12):
                edge = a + s * (b - a)
                nearest = min(nearest, np.linalg.norm(edge - point, axis=1).min())
    return nearest if inside else -nearest
