"""python -m jaxevent.cli"""

import sys

from jaxevent.cli import main

if __name__ == "__main__":
    sys.exit(main())
