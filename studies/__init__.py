"""Studies for the tables of README and docs: ``python -m studies``.

They run from a checkout, on the folders written by ``drake-safety train`` and ``evaluate``, and are
not part of the installed package.
"""
