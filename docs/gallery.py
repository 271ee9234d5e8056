"""Write docs/how-to/gallery.md from the examples: what each does, and its code. ``python docs/gallery.py``."""

import ast
import json
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "how-to" / "gallery.md"

HEAD = """# Examples

Nine programs that run as they are printed, seven scripts and two notebooks; a test runs all of them. Each takes a case
of yours, or works on an embedded one.

*Written by `python docs/gallery.py` from `examples/`, and held beside them by a test.*
"""


def script(path: Path) -> Iterator[str]:
    """A script: its docstring, then its code without it."""
    text = path.read_text(encoding="utf-8")
    first, _, rest = (ast.get_docstring(ast.parse(text)) or "").partition("\n")
    code = text.split('"""', 2)[2].strip("\n")
    yield f"## {path.name[:2]} {first}"
    yield rest.strip().replace(f"python examples/{path.name}", f"`python examples/{path.name}`", 1)
    yield f"```python\n{code}\n```"


def notebook(path: Path) -> Iterator[str]:
    """A notebook: its cells, the headline one level lower."""
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "code":
            yield f"```python\n{text}\n```"
        else:
            yield text.replace("# ", f"## {path.name[:2]} ", 1) if text.startswith("# ") else text


def gallery() -> str:
    """The page."""
    parts = [HEAD.rstrip("\n")]
    for path in sorted((ROOT / "examples").iterdir()):
        if path.suffix in (".py", ".ipynb"):
            parts += (script if path.suffix == ".py" else notebook)(path)
            parts.append(f"File: `examples/{path.name}`")
    return "\n\n".join(filter(None, parts)) + "\n"


if __name__ == "__main__":
    PAGE.write_text(gallery(), encoding="utf-8")
