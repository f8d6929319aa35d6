"""Types of the answers of the REST interface, for annotations.

Editors and type checkers read them from the stub beside this module. At run time each is a name
for a plain dictionary, so a client loads no list of their fields.
"""

import re
from pathlib import Path
from typing import Any, NewType

for _name in re.findall(
    r"^class (\w+)", Path(__file__).with_suffix(".pyi").read_text("utf-8"), re.M
):
    globals()[_name] = NewType(_name, dict[str, Any])
