"""Writes docs/reference/archives.md, with the service's file names: `python docs/archives.py`.

A test fails if the page differs.
"""

from __future__ import annotations

from pathlib import Path

from service.models import archive_reading as archive
from service.storage import backup
from service.storage.database.engine import FILE

TARGET = Path(__file__).parent / "reference/archives.md"
PAGE = """# Archives and backups

Both are tar files of plain files. [What they are for](../operations.md#take-a-model-elsewhere).

## An archive

A version of a model. `GET /v1/models/{{model}}/export` returns it, `POST /v1/models/import` reads it. The format is
POSIX ustar; each file occurs once, in any order. Links, folders, devices, extended headers and other names are refused.

| file | content |
| --- | --- |
| `{archive.CHECKSUMS}` | JSON object: hexadecimal sha256 of each file except `{archive.SIGNATURE}`, by name |
| `{archive.EXPORT}` | origin; `format` is `{archive.FORMAT}`, `format_version` {archive.FORMAT_VERSION} |
| `{archive.MANIFEST}` | description of the model, options, ranges and lineage |
| `{archive.TENSORS}` | numbers of the model, safetensors |
| `{archive.ROBOT}` | URDF used for the training, if any |
| `{archive.SIGNATURE}` | signature by an earlier build; ignored |

## Sign an archive

The service does not sign archives and checks no signatures. Sign the exported file with a tool of
[sigstore](https://docs.sigstore.dev), and verify it before the import. With sigstore for Python
(`pip install sigstore`):

```sh
python -m sigstore sign arm-v2.tar                  # writes arm-v2.tar.sigstore.json
python -m sigstore verify identity arm-v2.tar \\
  --cert-identity anna@example.com --cert-oidc-issuer https://accounts.google.com
```

With cosign:

```sh
cosign sign-blob arm-v2.tar --bundle arm-v2.tar.sigstore.json
cosign verify-blob arm-v2.tar --bundle arm-v2.tar.sigstore.json \\
  --certificate-identity anna@example.com --certificate-oidc-issuer https://accounts.google.com
```

Send both files. The identity is the signer's login address, the issuer is the login service. Both tools publish them in
a public log.

Versions that earlier builds imported may name a signer in `lineage.imported`, `signed_by`.

## A backup

A home. `lipserve backup` writes it, `lipserve restore` reads it. The format is GNU tar, with the files in this order.

| file | content |
| --- | --- |
| `datasets/….safetensors`, `versions/…/…`, `learning/….safetensors` | samples, versions, snapshots |
| `{FILE}` | the database at one moment, by SQLite's online backup |
| `{backup.MANIFEST}` | `format`: `{backup.FORMAT}`; `format_version`: {backup.FORMAT_VERSION}; `software`; \
time of the backup `at`; `files`: `size` and `sha256` of each file by name |

At that moment writers wait for some milliseconds, while files written since the start of the backup are opened. All
other copying does not block them. A file that the service deletes during the backup may be in the tar file, but not in
`files`; a restore ignores it. A restore is refused if another file is missing or has a wrong sha256, or if a row of the
database lacks its file.
"""


def document() -> str:
    """Return the page."""
    return PAGE.format(archive=archive, backup=backup, FILE=FILE)


if __name__ == "__main__":
    TARGET.write_text(document(), "utf-8")
