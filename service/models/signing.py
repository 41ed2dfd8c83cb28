"""Signatures of archives, ed25519: who has exported one, and that nothing of it was changed since.

Signed are PREFIX and the bytes of `checksums.json`, which has the sha256 of every other file of the archive, as an
import sees to. The signature is a file of its own, `signature.json`. It needs the extra `signing`, which is imported
where something is signed or a signature is there.
"""

from __future__ import annotations

import base64
import binascii
import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field

from lipcore.files.durable import sync
from service.foundation.errors import InvalidDataError, invalid_data
from service.foundation.settings import SIGNER, Settings

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

SIGNATURE = "signature.json"
ALGORITHM = "ed25519"
PREFIX = b"lipserve-archive-signature-v1\n"
"""Before what is signed: a signature of something else is none of an archive."""
MISSING = "the package cryptography: pip install 'lipserve[signing]'"
_BASE64 = r"[A-Za-z0-9+/]{%d}="


class Signature(BaseModel):
    """What `signature.json` says. signer: public key, as `signer_of` writes it."""

    model_config = ConfigDict(extra="forbid", strict=True)

    algorithm: str = Field(pattern=f"^{ALGORITHM}$")
    signer: str = Field(pattern=SIGNER)
    signature: str = Field(pattern=rf"^{_BASE64 % 86}=$")


class SigningKeyError(ValueError):
    """A private key cannot be used; the message says why."""


def check_installed(settings: Settings) -> None:
    """See that the service can sign and verify as it is set; raise ValueError (SigningKeyError for its key)."""
    if settings.signing_key_file is None and not settings.trusted_signers:
        return
    if find_spec("cryptography") is None:
        name = "SIGNING_KEY_FILE" if settings.signing_key_file else "TRUSTED_SIGNERS"
        raise ValueError(f"LIPSERVE_{name} is set, which needs {MISSING}")
    if settings.signing_key_file is not None:
        signer_of(read_key(settings.signing_key_file))


def make_key(path: Path) -> Ed25519PrivateKey:
    """Make a private key and write it into a new file, for its owner alone; raise FileExistsError."""
    from cryptography.hazmat.primitives import serialization as form  # noqa: PLC0415 - of an extra
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415

    key = Ed25519PrivateKey.generate()
    text = key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "wb") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    sync(path.parent)
    return key


def read_key(path: Path) -> Ed25519PrivateKey:
    """Read a private key in PEM, without a password; raise SigningKeyError, which repeats nothing of the file."""
    from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - of an extra
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415
    from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415

    try:
        key = load_pem_private_key(path.read_bytes(), None)
    except OSError as error:
        raise SigningKeyError(f"signing_key_file is {str(path)!r}, which cannot be read: {error.strerror}") from None
    except (ValueError, TypeError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PrivateKey):
        expected = "a private ed25519 key in PEM, as `lipserve keys signing` makes one"
        raise SigningKeyError(f"signing_key_file is {str(path)!r}, expected {expected}")
    return key


def signer_of(key: Ed25519PrivateKey) -> str:
    """The public part of a key, as settings and archives name it: `ed25519:` and base64 of its 32 bytes."""
    return f"{ALGORITHM}:{base64.b64encode(key.public_key().public_bytes_raw()).decode()}"


def sign(key: Ed25519PrivateKey, checksums: bytes) -> dict[str, str]:
    """What `signature.json` says of an archive whose `checksums.json` has these bytes."""
    signature = base64.b64encode(key.sign(PREFIX + checksums)).decode()
    return {"algorithm": ALGORITHM, "signer": signer_of(key), "signature": signature}


def verify(settings: Settings, signature: Signature | None, checksums: bytes) -> str | None:
    """Who has signed an archive, None where nobody has. Raise InvalidDataError for a signature that is not of these
    bytes, and for none, or that of somebody who is not trusted, where the settings require one."""
    if signature is None:
        if settings.require_signed:
            raise _unsigned(settings, "missing")
        return None
    if find_spec("cryptography") is None:
        raise invalid_data(SIGNATURE, "there", f"none: this service cannot verify signatures without {MISSING}")
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 - of an extra
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey  # noqa: PLC0415

    try:
        signer = Ed25519PublicKey.from_public_bytes(base64.b64decode(signature.signer.partition(":")[2], validate=True))
        signer.verify(base64.b64decode(signature.signature, validate=True), PREFIX + checksums)
    except (InvalidSignature, ValueError, binascii.Error):
        raise invalid_data(SIGNATURE, "broken", "the signature of this checksums.json by that signer") from None
    if settings.require_signed and signature.signer not in settings.signers:
        raise _unsigned(settings, f"of {signature.signer}")
    return signature.signer


def _unsigned(settings: Settings, given: str) -> InvalidDataError:
    trusted = ", ".join(settings.signers)
    return invalid_data(SIGNATURE, given, f"the signature of a signer of LIPSERVE_TRUSTED_SIGNERS: {trusted}")
