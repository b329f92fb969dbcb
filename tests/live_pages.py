"""What a browser sends to a live session, and a scenario that is learned from in a second."""


def packed(value):
    """MessagePack of short texts, numbers and maps: what a browser sends."""
    if isinstance(value, dict):
        items = [packed(one) for pair in value.items() for one in pair]
        return bytes([0x80 + len(value)]) + b"".join(items)
    text = value.encode()
    assert len(text) < 32
    return bytes([0xA0 + len(text)]) + text


def click(session, name):
    session.meshcat._InjectWebsocketMessage(packed({"type": "button", "name": name}))


def quick(scenario):
    """Trains in a second; what is learned is of no account here."""
    parameters = scenario.assessment
    parameters.epochs, parameters.ensemble_size, parameters.hidden_sizes = 20, 1, [32]
    parameters.perplexity, parameters.min_count = 5, 1
    return scenario
