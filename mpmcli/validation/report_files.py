"""Writes a report: report.json, report.md with its figures, and report.html, in which they are embedded."""

import json
from pathlib import Path

from mpmcli.errors import RunError
from mpmcli.output.durable import sealed, write_text
from mpmcli.plain_json import finite_json
from mpmcli.validation.figure_settings import draw_settings
from mpmcli.validation.figures import draw_case
from mpmcli.validation.journal import FIGURES
from mpmcli.validation.page_html import to_html
from mpmcli.validation.report import Report
from mpmcli.validation.report_page import SETTINGS_FIGURE, TITLE, figure_name, report_page


def write_report(report: Report, directory: Path) -> None:
    """Write the report into an existing directory, each file atomically.

    Raises:
        RunError: a file cannot be written.
    """
    pictures = {figure_name(entry): draw_case(entry) for entry in report.case_reports}
    if len(report.compared) > 1:
        pictures[SETTINGS_FIGURE] = draw_settings(report.compared)
    page = report_page(report)
    texts = {
        "report.json": json.dumps(finite_json(report.as_dict()), indent=1, ensure_ascii=False, allow_nan=False) + "\n",
        "report.md": page,
        "report.html": to_html(TITLE, page, {f"{FIGURES}/{name}": picture for name, picture in pictures.items()}),
    }
    try:
        (directory / FIGURES).mkdir(exist_ok=True)
        for name, content in pictures.items():
            with sealed(directory / FIGURES / name) as temporary:
                temporary.write_bytes(content)
        for name, text in texts.items():
            write_text(directory / name, text)
    except OSError as error:
        raise RunError(f"The report could not be written to {directory} ({error.strerror or error}).") from error
