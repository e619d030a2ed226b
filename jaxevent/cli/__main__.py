"""python -m jaxevent.cli"""

import sys

from jaxevent.cli import main

sys.exit(main())
