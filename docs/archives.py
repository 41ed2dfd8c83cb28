"""Writes docs/reference/archives.md: `python docs/archives.py`. Its names and sizes are those of the service's modules;
its example is signed with the first key of RFC 8032's test vectors. A test fails while the page is not that."""

from __future__ import annotations

import base64
import hashlib
import json
import textwrap
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from service.models import archive_reading as archive
from service.models import signing
from service.storage import backup
from service.storage.database.engine import FILE

TARGET = Path(__file__).parent / "reference/archives.md"
SEED = bytes.fromhex("9d61b19deffd5a60ba844af492ec2cc44449c5697b326919703bac031cae7f60")
"""A private key that everybody knows."""
PAGE = """# Archives and backups

Both are tar files of plain files. [What they are for](../operations.md#take-a-model-elsewhere).

## An archive

A version, as `GET /v1/models/{{model}}/export` answers it and `POST /v1/models/import` takes it. POSIX ustar; each file
once, in any order; links, folders, devices and extended headers are refused, and so is any other name.

| file | holds |
| --- | --- |
| `{archive.CHECKSUMS}` | JSON object: the sha256, in hexadecimal, of each other file but the signature, by name |
| `{signing.SIGNATURE}` | who has signed it; may be missing |
| `{archive.EXPORT}` | where it comes from; `format` is `{archive.FORMAT}`, `format_version` {archive.FORMAT_VERSION} |
| `{archive.MANIFEST}` | what the model is, its options, ranges and lineage |
| `{archive.TENSORS}` | its numbers, safetensors |
| `{archive.ROBOT}` | the URDF that it was trained with, where there was one |

## Its signature

`lipserve keys signing arm.pem` makes a private ed25519 key (RFC 8032) in PEM (PKCS #8, without a password) and prints
its public part, `ed25519:` and base64 of its 32 bytes. `LIPSERVE_SIGNING_KEY_FILE=arm.pem` signs every archive that is
exported from then on.

Signed are these bytes, and nothing else:

1. the {prefix_length} bytes `{prefix}` and a line feed (0x0a);
2. the bytes of `{archive.CHECKSUMS}`, as they stand in the archive.

As an import takes exactly the files that `{archive.CHECKSUMS}` names, each with its sha256, every byte of every file is
signed; names and padding of the tar file itself are not. `{signing.SIGNATURE}` is one JSON object with exactly these
fields:

| field | |
| --- | --- |
| `algorithm` | `{signing.ALGORITHM}` |
| `signer` | the public key, as above |
| `signature` | base64 of its 64 bytes |

An import refuses, with 422 `invalid_data`:

- a signature that is not of these bytes by that key, always;
- with `LIPSERVE_REQUIRE_SIGNED=true`, an archive without a signature, or by a signer that is not in
  `LIPSERVE_TRUSTED_SIGNERS` (public keys, separated by commas);
- a signed archive, where the service has no package `cryptography` (`lipserve[signing]`).

Else `lineage.imported` of the version names who has signed it, `signed_by`, and so does the audit log. Whom to trust is
yours to say: without `LIPSERVE_REQUIRE_SIGNED` anybody may have signed it. What was signed once stays so; a key cannot
be revoked but by taking it out of `LIPSERVE_TRUSTED_SIGNERS`. Releases up to 0.2 take no signed archive.

An example, with the first private key of RFC 8032 (section 7.1), which everybody knows:

```text
{example}
```

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


def example() -> str:
    """What is signed, and the signature, as text."""
    key = Ed25519PrivateKey.from_private_bytes(SEED)
    sums = json.dumps({archive.EXPORT: hashlib.sha256(b"{}").hexdigest()}).encode()
    said = signing.sign(key, sums)
    lines = [
        f"private key  {SEED.hex()}",
        f"signer       {said['signer']}",
        f"{archive.CHECKSUMS}, {len(sums)} bytes:",
        *textwrap.wrap(sums.decode(), 88, initial_indent="  ", subsequent_indent="  "),
        f"signed, {len(signing.PREFIX) + len(sums)} bytes, sha256",
        f"  {hashlib.sha256(signing.PREFIX + sums).hexdigest()}",
        f"signature, {len(base64.b64decode(said['signature']))} bytes:",
        f"  {said['signature']}",
    ]
    return "\n".join(lines)


def document() -> str:
    """The page."""
    names = {"archive": archive, "signing": signing, "backup": backup, "FILE": FILE, "example": example()}
    prefix = signing.PREFIX.decode().rstrip("\n")
    return PAGE.format(**names, prefix=prefix, prefix_length=len(signing.PREFIX))


if __name__ == "__main__":
    TARGET.write_text(document(), "utf-8")
