"""Croissant, a description of tables in JSON-LD that search engines and loaders of training code read.

Source: docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html; version 1.0 has lists, but no arrays.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_TERMS = (
    "arrayShape citeAs column containedIn equivalentProperty extract field fileProperty fileObject fileSet format "
    "includes isArray isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace "
    "samplingRate separator source subField transform"
)
# mlcroissant asks for https in addresses of schema.org, and for every term.
_CONTEXT: dict[str, Any] = {"@language": "en", "@vocab": "https://schema.org/", "sc": "https://schema.org/"}
_CONTEXT |= {"cr": "http://mlcommons.org/croissant/", "rai": "http://mlcommons.org/croissant/RAI/"}
_CONTEXT |= {"dct": "http://purl.org/dc/terms/", "conformsTo": "dct:conformsTo"}
_CONTEXT |= {term: f"cr:{term}" for term in _TERMS.split()} | {"dataType": {"@id": "cr:dataType", "@type": "@vocab"}}
_CONTEXT |= {name: {"@id": f"cr:{name}", "@type": "@json"} for name in ("data", "examples")}
_CONTEXT |= {name: {"@container": "@language"} for name in ("name", "description")}


def croissant(
    files: Mapping[str, tuple[int, str]],
    splits: Sequence[str],
    columns: Mapping[str, tuple[np.dtype | None, Sequence[int]]],
    **facts: str,
) -> dict[str, Any]:
    """Return the description of tables of Parquet in one directory; `facts` are those of schema.org of the dataset.

    Args:
        files: bytes and SHA-256 of each file, whose name begins with its split.
        splits: names of the splits.
        columns: type, None for text, and lengths of the axes, -1 where rows differ, of each column.
    """
    tables, parquet = {"fileSet": {"@id": "tables"}}, {"encodingFormat": "application/x-parquet"}
    split = tables | {"extract": {"fileProperty": "fullpath"}, "transform": {"regex": f"^({'|'.join(splits)}).*$"}}
    named = {"field": {"@id": "splits/name"}}
    fields = [_field("trajectories/split", None) | {"source": split, "references": named}]
    for name, (dtype, shape) in columns.items():
        array = {"isArray": True, "arrayShape": ",".join(map(str, shape))} if shape else {}
        fields.append(
            _field(f"trajectories/{name}", dtype) | array | {"source": tables | {"extract": {"column": name}}}
        )
    objects = [
        _node("FileObject", name) | {"contentUrl": name, "contentSize": f"{size} B", "sha256": digest} | parquet
        for name, (size, digest) in files.items()
    ]
    known = {"dataType": "cr:Split", "key": {"@id": "splits/name"}, "field": [_field("splits/name", None)]}
    known["data"] = [{"splits/name": one} for one in splits]
    rows = {"key": {"@id": "trajectories/number"}, "field": fields}
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        **facts,
        "distribution": [*objects, _node("FileSet", "tables") | {"includes": "*.parquet"} | parquet],
        "recordSet": [_node("RecordSet", "splits") | known, _node("RecordSet", "trajectories") | rows],
    }


def _node(kind: str, name: str) -> dict[str, Any]:
    return {"@type": f"cr:{kind}", "@id": name, "name": name.rpartition("/")[2]}


def _field(name: str, dtype: np.dtype | None) -> dict[str, Any]:
    """Return a field of a type, such as cr:Float32, cr:UInt8, sc:Boolean, or text."""
    known = {None: "sc:Text", "bool": "sc:Boolean"}
    key = dtype and dtype.name
    return _node("Field", name) | {"dataType": known.get(key) or "cr:" + key.capitalize().replace("Uint", "UInt")}
