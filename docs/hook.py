"""Links of the documents to files outside docs/, which a site has not."""

import re
from os.path import normpath
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
MOVED = {"README.md": "index.md", "CHANGELOG.md": "changelog.md"}
"""Documents of the project's folder, which are pages of the site too."""
LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<to>[^)#:\s]+)(?P<anchor>#[^)]*)?\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that lie outside docs/."""
    for name, page in MOVED.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text.replace("](docs/answer.png)", "](answer.png)")))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Lead links to the site's pages where there is one, else to the repository where its address is known."""
    moved = {page: name for name, page in MOVED.items()}
    here = ROOT / moved.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def led(link: re.Match[str]) -> str:
        text, target, anchor = link["text"], Path(normpath(here.parent / link["to"])), link["anchor"] or ""
        if not target.exists():
            raise PluginError(f"{here.relative_to(ROOT)}: {link['to']} is not there; mend the link")
        inside = target.relative_to(ROOT).as_posix()
        if inside in MOVED:
            return f"[{text}]({MOVED[inside]}{anchor})"
        if target.parent == ROOT / "docs":
            return f"[{text}]({target.name}{anchor})"
        return f"[{text}]({config.repo_url}/blob/main/{inside}{anchor})" if config.repo_url else text

    return LINK.sub(led, markdown)
