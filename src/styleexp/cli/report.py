"""``styleexp-report``: HTML pages of runs, sweeps and the user study."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from styleexp.cli.ending import ends_well
from styleexp.system.errors import UserError

DESCRIPTION = """\
Write one self-contained HTML page about a run, about all runs below a folder, or about several runs
side by side, and print its path. For the user study, see 'styleexp-report study --help'."""


@ends_well
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 after printing a user error."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        written = study(given[1:]) if given[:1] == ["study"] else report(given)
        for path in written:
            print(path)
    except UserError as error:
        print(f"styleexp-report: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        raise
    except OSError as error:
        where = f"'{error.filename}'" if error.filename else "the page"
        print(f"styleexp-report: {where} cannot be written ({error.strerror}).", file=sys.stderr)
        return 2
    return 0


def report(given: list[str]) -> list[Path]:
    """Write the requested pages; return their paths."""
    options = _parser().parse_intermixed_args(given)
    for folder in options.folders:
        if not folder.is_dir():
            raise UserError(f"there is no folder '{folder}': give a run's or a sweep's folder.")
    if len(options.folders) > 1:
        if options.notebooks is not None:
            raise UserError("--notebooks takes a single folder.")
        from styleexp.experiments.reports import compare_page

        written = compare_page.write(options.folders, options.out)
    elif options.out is not None:
        raise UserError("--out is for the page of several runs: the others lie in their folder.")
    elif options.notebooks is not None:
        from styleexp.experiments.reports import notebooks

        pages, left_out = notebooks.execute(options.folders[0], options.notebooks)
        for note in left_out:
            print(f"styleexp-report: {note}", file=sys.stderr)
        return pages
    else:
        written = _page(options.folders[0], not options.no_run_pages)
    if options.open:
        import webbrowser

        webbrowser.open(written.resolve().as_uri())
    return [written]


def _page(folder: Path, run_pages: bool) -> Path:
    """Write the page of a run, of all runs below a folder, or of an experiment's newest sweep."""
    from styleexp.experiments.reports import page, sweep_page
    from styleexp.runs import finding

    if finding.is_run(folder):
        return page.rewrite(
            folder, lambda note: print(f"styleexp-report: note: {note}", file=sys.stderr)
        )
    sweeps = finding.sweeps_of_experiment(folder)
    if len(sweeps) > 1:
        print(
            f"styleexp-report: note: '{folder}' has {len(sweeps)} sweeps; this is the newest, of "
            f"{sweeps[-1].name} (give its folder for another)",
            file=sys.stderr,
        )
    return sweep_page.write(sweeps[-1] if sweeps else folder, run_pages)


def study(given: list[str]) -> list[Path]:
    """Write the study's page or sheets, or analyse the answers."""
    options = _study_parser().parse_args(given)
    if options.analyse:
        from styleexp.experiments.reports import study_results

        found = study_results.read(options.analyse, options.key)
        for note in found.left_out:
            print(f"styleexp-report: {note}", file=sys.stderr)
        return study_results.analyse(found, options.out or options.analyse[0].parent)
    if options.folder is None:
        raise UserError(
            "give the folder with the runs to be rated, or --analyse with the answer files."
        )
    if not options.folder.is_dir():
        raise UserError(f"there is no folder '{options.folder}': give one with finished runs.")
    if options.sheets is not None:
        from styleexp.experiments.reports import sheets

        return [sheets.write(options.folder, options.sheets, options.seed)]
    from styleexp.experiments.reports import study as study_page

    return [study_page.write(options.folder, options.seed, options.title)]


def _study_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="styleexp-report study",
        description="The user study of Fig. 9: write a page on which people rate every finished "
        "run below a folder (study.html), or pictures for raters who can't open one (--sheets), or "
        "analyse the answers (--analyse).",
    )
    parser.add_argument(
        "folder", type=Path, nargs="?", metavar="FOLDER", help="folder with the runs"
    )
    parser.add_argument("--title", default="Rating of stylised meshes", help="title of the page")
    parser.add_argument("--seed", type=int, default=0, help="seed for the order of the pairs")
    parser.add_argument(
        "--sheets",
        type=Path,
        metavar="OUT",
        help="write no page, but a picture of each result without its name, and catch trials, to "
        "OUT/sheets; what they show is in OUT/key.json, and OUT/ratings.csv is to be filled in",
    )
    parser.add_argument(
        "--analyse",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="participants' files (JSON), or tables of ratings of sheets (CSV): write fig9.png, "
        "fig9.csv, ratings.csv and study.json",
    )
    parser.add_argument(
        "--key",
        type=Path,
        metavar="FILE",
        help="key.json of the sheets that the tables rate (default: the one beside the table)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FOLDER",
        help="output folder for these files (default: that of the first file)",
    )
    return parser


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="styleexp-report",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "folders",
        type=Path,
        nargs="+",
        metavar="FOLDER",
        help="folder of a run, a sweep, or several sweeps, or of an experiment, whose newest sweep "
        "is shown; or several folders of runs, which are "
        "compared with the first",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="file for the page of several runs (default: compare-….html in the folder that they "
        "have in common)",
    )
    parser.add_argument(
        "--notebooks",
        nargs="*",
        metavar="NAME",
        help="execute the notebooks of the paper's figures into FOLDER/notebooks: those named, "
        "or all that have runs here",
    )
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.add_argument(
        "--no-run-pages",
        action="store_true",
        help="don't write pages for finished runs of a sweep that have none",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
