"""Run a notebook's cells in one process, in their order, and print what each shows: ``python notebooks.py FILE``.

A notebook of this project is plain Python: no magic, no widget. So no kernel, and none of the thirty packages of one.
"""

import ast
import json
import sys
from pathlib import Path


def run(path):
    """Execute every cell; of a last expression its HTML, else its text, is printed, as a notebook would show it."""
    names = {"__name__": "__main__"}
    for number, cell in enumerate(json.loads(Path(path).read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] != "code":
            continue
        body = ast.parse("".join(cell["source"]), f"{path}, cell {number}").body
        shown = [ast.Expression(body.pop().value)] if isinstance(body[-1], ast.Expr) else []
        exec(compile(ast.Module(body, []), f"{path}, cell {number}", "exec"), names)
        for expression in shown:
            value = eval(compile(expression, f"{path}, cell {number}", "eval"), names)
            if value is not None:
                sys.stdout.write((value._repr_html_() if hasattr(value, "_repr_html_") else repr(value)) + "\n")


if __name__ == "__main__":
    run(sys.argv[1])
