"""``styleexp-report --notebooks``: the notebooks of ``reports/``, executed, as .ipynb and HTML."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from styleexp.experiments.reports import html
from styleexp.experiments.reports.notebook import belongs
from styleexp.runs import finding
from styleexp.system.errors import UserError

NOTEBOOKS: dict[str, tuple[str, ...]] = {
    "layer_ablation": ("layer_ablation",),
    "sigma_ablation": ("sigma_ablation",),
    "styles": ("mesh_styles", "multi_style", "image_styles"),
    "baselines": ("baselines_mesh", "baselines_image"),
    "backends": ("renderer_ablation", "backend_agreement"),
    "method": ("method_ablation",),
    "board": ("board",),
    "appendix": (),
}
"""Experiments of each notebook, which is skipped if none of them ran. Empty: uses all runs."""


def execute(folder: Path, names: Sequence[str] = ()) -> tuple[list[Path], list[str]]:
    """Execute the notebooks that have runs below ``folder``, or those named, into
    ``folder/notebooks``.

    Returns the HTML files, and the reason for each skipped notebook. Raises `UserError` for an
    unknown name, a failing notebook, missing packages, or if there is no run.
    """
    try:
        import jupytext
        import nbconvert  # noqa: F401
        import papermill
    except ImportError as error:
        raise UserError(
            f"executing notebooks needs {error.name}: pip install 'styleexp[report]'."
        ) from None
    from styleexp.system.errors import unknown_name

    for name in names:
        if name not in NOTEBOOKS:
            raise unknown_name("notebook", name, NOTEBOOKS)
    runs = finding.find(folder)
    if not runs:
        raise UserError(f"there is no run below '{folder}': give the folder of a sweep or a plan.")
    target = folder / "notebooks"
    written, left_out = [], []
    for name in names or NOTEBOOKS:
        experiments = NOTEBOOKS[name]
        if experiments and not any(belongs(run, experiments) for run in runs):
            wanted = " or ".join(experiments)
            left_out.append(f"{name} was left out: there is no run of {wanted} below '{folder}'.")
            continue
        target.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="styleexp-notebook-") as work:
            source, done = Path(work) / "source.ipynb", Path(work) / "done.ipynb"
            text = (resources.files("styleexp.notebooks") / f"{name}.py").read_text("utf-8")
            jupytext.write(jupytext.reads(text, fmt="py:percent"), source)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # papermill's own, about its dependencies
                    papermill.execute_notebook(
                        source,
                        done,
                        parameters={
                            "folder": str(folder.resolve()),
                            "tables": str(target.resolve()),
                        },
                        kernel_name="python3",
                        language="python",
                        progress_bar=False,
                        log_output=False,
                        config=_kernel(),
                        extra_arguments=["--log-level=CRITICAL"],  # hide the converter's output
                    )
            except papermill.PapermillExecutionError as error:
                raise UserError(
                    f"the notebook '{name}' failed ({error.ename}: {error.evalue})."
                ) from None
            notebook = html.save(target / f"{name}.ipynb", done.read_text(encoding="utf-8"))
        written.append(html.save(target / f"{name}.html", as_page(notebook)))
    return written, left_out


def _kernel() -> Any:
    """Kernel manager that uses Unix sockets, where available, instead of open ports."""
    from traitlets.config import Config

    transport = "ipc" if os.name == "posix" else "tcp"
    return Config({"KernelManager": {"transport": transport}})


def as_page(notebook: Path) -> str:
    """Render an executed notebook without its code as a self-contained page, without external
    scripts."""
    import nbformat
    from markupsafe import Markup
    from nbconvert import HTMLExporter

    content = nbformat.read(notebook, as_version=4)
    exporter = HTMLExporter(template_name="basic", embed_images=True, exclude_input=True)
    body, _ = exporter.from_notebook_node(content)
    return html.render(
        "notebook.html",
        [],
        title=notebook.stem.replace("_", " "),
        body=Markup(body),
        notebook=notebook.name,
    )
