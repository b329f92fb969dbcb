"""The three quantities that Γ stands for, and their names.

Literal Γ is b_safe of the grid, as the paper defines it, at most 1 - μ: 0.7 before adaptation.
Normalised Γ is b_safe / (1 - μ), from 0 to 1. Calibrated Γ is a probability of safety from the
maps' heads, and 0 where the belief is "don't know"; without heads it is normalised Γ otherwise.
"""

LITERAL, NORMALIZED, CALIBRATED = "literal", "normalized", "calibrated"
"""Fields of an assessment's result."""
GAMMA = {LITERAL: "literal Γ", NORMALIZED: "normalised Γ", CALIBRATED: "calibrated Γ"}
"""What messages, tables and figures call a field."""
PORTS = {
    LITERAL: "safety_probability",
    NORMALIZED: "normalized_safety_probability",
    CALIBRATED: "calibrated_safety_probability",
}
"""Output port of :class:`~drake_safety.systems.safety_assessor.SafetyAssessor` for a field."""


def gamma_of_port(port: str) -> str:
    """What messages call the quantity of an output port.

    Args:
        port: One of `PORTS`.
    """
    return next(GAMMA[name] for name, its_port in PORTS.items() if its_port == port)
