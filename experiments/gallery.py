"""The pages of the gallery: scripts of docs/gallery, executed as notebooks when the site is built.

`on_files` is a hook of MkDocs (`mkdocs.yml`). The scripts have jupytext's percent format, so that
they are code under review and run as tests. jupytext (MIT) reads them, nbclient (BSD) executes
them; both are small and Jupyter's own. Their pages are Markdown, so that MkDocs checks the links:
mkdocs-jupyter does not, and puts 575 kB of styles into each page. myst-nb needs Sphinx.

`JAXEVENT_GALLERY=0 mkdocs build` leaves the outputs out.
"""

import base64
import os
import re
import tempfile
from pathlib import Path
from typing import Any

FOLDER = "gallery"
TIMEOUT_S = 300

last_pictures: dict[str, str] = {}  # of each notebook that was executed, for the index


def read_notebook(path: Path, execute: bool) -> Any:
    """Read a script as a notebook, with its outputs where it is executed."""
    import jupytext

    notebook = jupytext.read(path)
    if execute:
        from nbclient import NotebookClient

        with tempfile.TemporaryDirectory() as folder:
            options: dict[str, Any] = {
                "timeout": TIMEOUT_S,
                "resources": {"metadata": {"path": folder}},
                "extra_arguments": ["--log-level=ERROR"],
            }
            NotebookClient(notebook, **options).execute()
        for cell in notebook.cells:  # without progress bars and warnings of this machine
            if cell.cell_type == "code":
                cell.outputs = [one for one in cell.outputs if one.get("name") != "stderr"]
    return notebook


def fence(text: str, language: str) -> str:
    """Format a block of text."""
    return f"```{language}\n{text.rstrip()}\n```"


def format_output(output: Any, stem: str, pictures: dict[str, bytes]) -> str:
    """Format a cell's output as Markdown; adds its picture to `pictures`."""
    if output.output_type == "stream":
        return fence(output.text, "text")
    data = output.get("data", {})
    if "image/png" in data:
        name = f"{stem}_{len(pictures)}.png"
        pictures[name] = base64.b64decode(data["image/png"])
        return f"![Figure {len(pictures)} of this notebook]({name})"
    if "text/html" in data:
        html = re.sub(r"<style.*?</style>", "", data["text/html"], flags=re.DOTALL)
        return f'<div class="output">{"".join(map(str.strip, html.splitlines()))}</div>'
    text = data.get("text/plain", "")
    return "" if re.match(r"<.* at 0x\w+>$", text) or not text else fence(text, "text")


def format_page(notebook: Any, stem: str) -> tuple[str, dict[str, bytes]]:
    """Format a notebook as a page of Markdown, with the pictures it shows."""
    parts, pictures = [], {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(fence(cell.source.replace("  # fmt: skip", ""), "python"))
        parts += [format_output(output, stem, pictures) for output in cell.outputs]
    title, _, rest = "\n\n".join(part for part in parts if part).partition("\n")
    return f"{title}\n\n[Download this notebook]({stem}.ipynb)\n{rest}\n", pictures


def on_page_markdown(markdown: str, page: Any, **context: Any) -> str:
    """Show a picture of each notebook in the index."""
    if page.file.src_uri == f"{FOLDER}/index.md":
        for stem, picture in last_pictures.items():
            row = re.compile(rf"\| (\[(.*?)\]\({stem}\.md\))")
            markdown = row.sub(rf"| [![\2]({picture})]({stem}.md)<br>\1", markdown)
    return markdown


def on_files(files: Any, config: Any) -> Any:
    """Replace the scripts by their pages, notebooks and pictures."""
    import nbformat
    from mkdocs.structure.files import File

    execute = os.environ.get("JAXEVENT_GALLERY") != "0"
    for path in sorted(Path(config.docs_dir, FOLDER).glob("*.py")):
        files.remove(files.get_file_from_path(f"{FOLDER}/{path.name}"))
        notebook = read_notebook(path, execute)
        page, pictures = format_page(notebook, path.stem)
        last_pictures.update((path.stem, name) for name in pictures)
        made = {f"{path.stem}.md": page, f"{path.stem}.ipynb": nbformat.writes(notebook)}
        for name, content in (made | pictures).items():
            files.append(File.generated(config, f"{FOLDER}/{name}", content=content))
    return files
