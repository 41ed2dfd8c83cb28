"""Archives unpacked, changed and packed again, correctly or maliciously."""

import hashlib
import io
import json
import tarfile
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tests.service.data import error, service_of

MANIFEST, TENSORS = "manifest.json", "model.safetensors"
TAR = {"content-type": "application/x-tar"}
Files = dict[str, bytes]


def exported(api: Any, model: str, **params: Any) -> bytes:
    """Export a version as an archive."""
    answer = api.get(f"/v1/models/{model}/export", params=params)
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == TAR["content-type"]
    assert int(answer.headers["content-length"]) == len(answer.content)
    return answer.content


def unpack(archive: bytes) -> Files:
    """Return the members by name, as another program reads them."""
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        return {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]


def pack(files: Mapping[str, bytes], form: int = tarfile.USTAR_FORMAT) -> bytes:
    """Return a tar file of these members."""
    return pack_members([(member(name, content), content) for name, content in files.items()], form)


def member(name: str, content: bytes = b"", **fields: Any) -> tarfile.TarInfo:
    """Return a header; fields: of `TarInfo`."""
    info = tarfile.TarInfo(name)
    info.size = len(content)
    for field, value in fields.items():
        setattr(info, field, value)
    return info


def pack_members(members: list[tuple[tarfile.TarInfo, bytes]], form: int = tarfile.USTAR_FORMAT) -> bytes:
    """Return a tar file of any headers."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=form) as tar:
        for info, content in members:
            tar.addfile(info, io.BytesIO(content))
    return file.getvalue()


def with_first_header(archive: bytes, place: int, changed: bytes) -> bytes:
    """Return a tar file with other bytes in its first header, and the checksum that matches."""
    packed = bytearray(archive)
    packed[place : place + len(changed)] = changed
    packed[148:156] = b" " * 8
    packed[148:156] = f"{sum(packed[:512]):06o}\0 ".encode()
    return bytes(packed)


def with_checksums(files: Mapping[str, bytes]) -> Files:
    """Return the members with correct checksums."""
    rest = {name: content for name, content in files.items() if name != "checksums.json"}
    sums = {name: hashlib.sha256(content).hexdigest() for name, content in rest.items()}
    return {"checksums.json": json.dumps(sums).encode(), **rest}


def with_json(files: Mapping[str, bytes], name: str, change: Callable[[dict[str, Any]], object]) -> Files:
    """Return the members with a changed JSON file, and checksums and manifest that match."""
    value = json.loads(files[name])
    change(value)
    return with_checksums({**files, name: json.dumps(value).encode()})


def with_payload(files: Mapping[str, bytes], payload: bytes) -> Files:
    """Return the members with other bytes for the tensors, and checksums and manifest that match."""

    def update_tensors(manifest: dict[str, Any]) -> None:
        manifest["tensors"] |= {"bytes": len(payload), "sha256": hashlib.sha256(payload).hexdigest()}

    return with_json({**files, TENSORS: payload}, MANIFEST, update_tensors)


def with_tensors(files: Mapping[str, bytes], change: Callable[[dict[str, np.ndarray]], object]) -> Files:
    """Return the members with changed tensors, and a manifest with their hyperparameters."""
    tensors = load_tensors(files[TENSORS])
    change(tensors)
    params = {name.partition("/")[2]: value.tolist() for name, value in tensors.items() if name.startswith("params/")}
    changed = with_payload(files, save_tensors(tensors))
    return with_json(changed, MANIFEST, lambda manifest: manifest.update(hyperparameters=params))


def with_header(files: Mapping[str, bytes], change: Callable[[dict[str, Any]], Any]) -> Files:
    """Return the members with a changed header of the tensors, whose bytes stay."""
    payload = files[TENSORS]
    length = int.from_bytes(payload[:8], "little")
    header = json.loads(payload[8 : 8 + length])
    changed = change(header)
    text = json.dumps(header if changed is None else changed).encode()
    return with_payload(files, len(text).to_bytes(8, "little") + text + payload[8 + length :])


def import_archive(api: Any, archive: bytes, **params: Any) -> Any:
    """Import an archive; return the answer."""
    return api.post("/v1/models/import", content=archive, headers=TAR, params=params)


def imported(api: Any, archive: bytes, **params: Any) -> Any:
    """Import an archive that must be accepted; return the version."""
    answer = import_archive(api, archive, **params)
    assert answer.status_code == 201, answer.text
    return answer.json()


def rejected_field(api: Any, archive: bytes, *words: str) -> str:
    """Check that an archive is rejected with these words, and that nothing of it is stored; return the field."""
    files = service_of(api).files
    before = sorted(files.versions.iterdir())
    body = error(import_archive(api, archive, name="refused"), 422, "invalid_data")
    for word in words:
        assert word in body["message"], body
    assert api.get("/v1/models/refused").status_code == 404
    assert sorted(files.versions.iterdir()) == before
    assert list(files.uploads.iterdir()) == []
    return body["detail"][0]["field"]


def assert_rejected(api: Any, archive: bytes, field: str, *words: str) -> None:
    """Check that an archive is rejected with this field and these words, and that nothing of it is stored."""
    assert rejected_field(api, archive, *words) == field
