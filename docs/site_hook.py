"""For the site (mkdocs.yml): a page of the API reference for every room, made from the docstrings of its modules.

A page that would load anything from another server is an error.
"""

import re
from pathlib import Path

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
PARTS = ("planning", "twin")

ELSEWHERE = r"""=["'](?:https?:)?//[^"']*"""
LOADED = re.compile(rf"<(?:script|img|iframe)[^>]*\ssrc{ELSEWHERE}|<link[^>]*\srel=\S*stylesheet[^>]*\shref{ELSEWHERE}")
"""What a browser loads by itself; links that a reader follows are none."""


def rooms():
    """Every folder of modules: its path and the modules in it, by full name."""
    for part in PARTS:
        for folder in sorted(path.parent for path in (ROOT / part).rglob("__init__.py")):
            modules = sorted(path.stem for path in folder.glob("*.py") if not path.stem.startswith("__"))
            yield folder.relative_to(ROOT), modules


def page_of(room, modules):
    """Markdown that mkdocstrings fills."""
    name = f"puncture_twin.{'.'.join(room.parts)}"
    lines = [f"# {room}", "", f"::: {name}", "    options: {members: false, show_root_heading: false}", ""]
    lines += [line for module in modules for line in ("", f"## {module}", "", f"::: {name}.{module}")]
    return "\n".join(lines) + "\n"


def on_files(files, config):
    """Add the pages."""
    for room, modules in rooms():
        path = f"reference/rooms/{room.as_posix().replace('/', '-')}.md"
        files.append(File.generated(config, path, content=page_of(room, modules)))
    return files


def on_page_markdown(markdown, page, config, files):
    """List the rooms below the public API."""
    if page.file.src_uri != "reference/api.md":
        return markdown
    names = [room.as_posix() for room, _ in rooms()]
    links = [f"- [{name}](rooms/{name.replace('/', '-')}.md)" for name in names]
    return "\n".join([markdown, "", "## Rooms", "", *links, ""])


def on_post_page(output, page, config):
    """Hold that the site stands alone."""
    found = LOADED.search(output.replace(config["site_url"] or "\0", ""))
    if found:
        raise PluginError(f"{page.file.src_uri} loads {found[0]}")
    return output
