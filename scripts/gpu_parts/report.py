"""The report: the rows of all parts as Markdown."""

from pathlib import Path

from gpu_parts.parts import PARTS, Part
from gpu_parts.records import DONE, Record, read_record, write_whole

NAME = "report.md"


def write_report(folder: Path) -> None:
    """Renew the report of a folder from the parts that are in it."""
    write_whole(folder / NAME, report_of({part.name: read_record(folder / f"{part.name}.json") for part in PARTS}))


def report_of(records: dict[str, Record | None]) -> str:
    """Return the sections of the parts that began, and at the end those that did not."""
    sections = [section(part, record) for part in PARTS if (record := records.get(part.name)) and began(record)]
    absent = [part.title for part in PARTS if not (record := records.get(part.name)) or not began(record)]
    if absent:
        sections.append(f"Not measured: {', '.join(absent)}.")
    return "\n\n".join(sections) + "\n"


def began(record: Record) -> bool:
    """Return whether there is something to tell of a part."""
    return bool(record.rows or record.failures or record.missing)


def section(part: Part, record: Record) -> str:
    """Return the section of a part: its tables, and what failed, was left out or was not reached."""
    lines = [f"### {part.title}", "", part.section(record.rows), ""]
    lines += [f"* {key}: not measured, {row['skipped']}" for key, row in record.rows.items() if "skipped" in row]
    lines += [f"* {key}: failed, {failure(text)}" for key, text in record.failures.items()]
    if record.missing:
        lines.append(f"* {record.missing}: the time was up.")
    if record.state != DONE and not record.failures:
        lines.append("* The part is not complete.")
    return "\n".join(lines).strip()


def failure(text: str) -> str:
    """Return the cause, and the last line that was written, on one line."""
    first, *rest = text.splitlines()
    return f"{first}: `{rest[-1].strip()}`" if rest else first


def measured(rows: dict[str, dict]) -> dict[str, dict]:
    """Return the rows that were measured."""
    return {key: row for key, row in rows.items() if "skipped" not in row}
