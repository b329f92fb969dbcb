"""How what the maps expect changes with their inputs, for whoever moves a plan to safety.

Γ itself is flat where all corners of a cell agree, and says nothing of the way out. The logit of
the maps' safety heads, which is learned together with it, has a slope everywhere.
"""

from __future__ import annotations

import numpy as np

from drake_safety.learning.assessment import SafetyAssessment
from drake_safety.learning.trained_maps import Embedding


def unsafe_logits(
    assessment: SafetyAssessment,
    state: np.ndarray,
    desired_preview: np.ndarray,
    features: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean logit of an unsafe end, and its gradient with respect to x.

    Args:
        assessment: A fitted assessment of the sharpened mode.
        state: States as the assessor sees them, (N, n_s).
        desired_preview: Coming desired outputs, (N, H*n_z).
        features: Features, (N, n_f).

    Returns:
        x as the maps see it (N, n_x), the logit (N,) and its gradient (N, n_x).

    Raises:
        ValueError: The maps have no safety head, as in the paper's mode.
    """
    x = assessment._inputs(state, desired_preview, features)
    logit, gradient = logit_gradient(assessment.embedding_, x)
    return x, logit, gradient


def logit_gradient(embedding: Embedding, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean logit of a stack of maps at x (N, n_x), and its gradient: (N,) and (N, n_x).

    Raises:
        ValueError: The maps have no safety head.
    """
    if not embedding.has_safety_head:
        raise ValueError("gradients: maps without a safety head expect no unsafe end")
    w = embedding.weights
    logit, gradient = np.zeros(len(x)), np.zeros(np.shape(x))
    for k in range(embedding.num_members):
        z = np.asarray(x, dtype=float)
        is_active = []
        for i in range(embedding.num_layers):
            z = z @ w[f"trunk.{i}.weight"][k] + w[f"trunk.{i}.bias"][k]
            is_active.append(z > 0.0)
            z = np.maximum(z, 0.0)
        y = z @ w["output.weight"][k][:, :2] + w["output.bias"][k][:2]
        hidden = y @ w["safety.0.weight"][k] + w["safety.0.bias"][k]
        logit += (np.maximum(hidden, 0.0) @ w["safety.1.weight"][k] + w["safety.1.bias"][k])[:, 0]
        back = (hidden > 0.0) * w["safety.1.weight"][k][:, 0]
        back = back @ w["safety.0.weight"][k].T @ w["output.weight"][k][:, :2].T
        for i in reversed(range(embedding.num_layers)):
            back = (back * is_active[i]) @ w[f"trunk.{i}.weight"][k].T
        gradient += back
    return logit / embedding.num_members, gradient / embedding.num_members
