"""``python -m drake_safety.cli`` is ``drake-safety``."""

from drake_safety.cli import main

main()
