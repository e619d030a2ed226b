"""The command line as a module: `python -m jaxevent`."""

import sys

from jaxevent.cli import main

if __name__ == "__main__":
    sys.exit(main())
