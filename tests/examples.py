"""How many examples a test of random recordings takes: few in the suite, more where asked for.

JAXEVENT_EXAMPLES=20 python -m pytest tests/reconstruction -k equals
"""

import os

import hypothesis

TIMES = int(os.environ.get("JAXEVENT_EXAMPLES", "1"))


def examples(number: int) -> hypothesis.settings:
    """So many times JAXEVENT_EXAMPLES."""
    return hypothesis.settings(max_examples=number * TIMES)
