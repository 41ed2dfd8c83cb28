"""Writes docs/reference/archives.md: `python docs/archives.py`. Its names and sizes are those of the service's modules;
a test fails while the page is not that."""

from __future__ import annotations

from pathlib import Path

from service.models import archive_reading as archive
from service.storage import backup
from service.storage.database.engine import FILE

TARGET = Path(__file__).parent / "reference/archives.md"
PAGE = """# Archives and backups

Both are tar files of plain files. [What they are for](../operations.md#take-a-model-elsewhere).

## An archive

A version, as `GET /v1/models/{{model}}/export` answers it and `POST /v1/models/import` takes it. POSIX ustar; each file
once, in any order; links, folders, devices and extended headers are refused, and so is any other name.

| file | holds |
| --- | --- |
| `{archive.CHECKSUMS}` | JSON object: by name, the hexadecimal sha256 of each other file but `{archive.SIGNATURE}` |
| `{archive.EXPORT}` | where it comes from; `format` is `{archive.FORMAT}`, `format_version` {archive.FORMAT_VERSION} |
| `{archive.MANIFEST}` | what the model is, its options, ranges and lineage |
| `{archive.TENSORS}` | its numbers, safetensors |
| `{archive.ROBOT}` | the URDF that it was trained with, where there was one |
| `{archive.SIGNATURE}` | a signature by an earlier build; ignored |

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

Send both files. The identity is the address that the signer has logged in with, the issuer is the login service. Both
tools write them into a public log.

Versions that earlier builds imported may name a signer in `lineage.imported`, `signed_by`.

## A backup

A home, as `lipserve backup` writes it and `lipserve restore` takes it: GNU tar, in this order.

| file | holds |
| --- | --- |
| `datasets/….safetensors`, `versions/…/…`, `learning/….safetensors` | samples, versions, snapshots, all whole |
| `{FILE}` | the database as of one moment, by SQLite's online backup |
| `{backup.MANIFEST}` | `format`: `{backup.FORMAT}`; `format_version`: {backup.FORMAT_VERSION}; `software`; \
the moment `at`; `files`: `size` and `sha256` of each by name |

At that moment writers wait for some milliseconds, while what came since the copying began is opened; all else is copied
beside them. What the service deletes meanwhile may be in the tar file, and is not in `files`: a restore leaves it out.
It is refused unless the rest is there with its sha256, and unless each row of the database has its file.
"""


def document() -> str:
    """The page."""
    return PAGE.format(archive=archive, backup=backup, FILE=FILE)


if __name__ == "__main__":
    TARGET.write_text(document(), "utf-8")
