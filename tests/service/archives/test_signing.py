"""Signed archives: who has signed one, that nothing was changed, and what is refused."""

import base64
import json

import pytest
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ed25519, rsa
from fastapi.testclient import TestClient
from pydantic import ValidationError

from service.app import create_app
from service.foundation.settings import Settings
from service.models import signing
from tests.service.archives.packing import MANIFEST, TENSORS, exported, pack, send, unpack, vouched
from tests.service.data import ADDRESS, error
from tests.service.models.versions import publish, worse

SIGNATURE, CHECKSUMS, EXPORT = "signature.json", "checksums.json", "export.json"
SIGNED = b"lipserve-archive-signature-v1\n"
"""Before checksums.json in what is signed, as documented."""


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    """Files of two private keys, and the public parts."""
    folder = tmp_path_factory.mktemp("keys")
    return {name: (folder / name, signing.signer_of(signing.make_key(folder / name))) for name in ("ours", "theirs")}


def service(folder, **settings):
    return TestClient(create_app(Settings(home=folder, **settings)), ADDRESS)


@pytest.fixture(scope="module")
def exporter(tmp_path_factory, keys):
    with service(tmp_path_factory.mktemp("exporter"), signing_key_file=keys["ours"][0]) as api:
        publish(api, "arm")
        publish(api, "other", worse())
        yield api


@pytest.fixture(scope="module")
def archive(exporter):
    return unpack(exported(exporter, "arm"))


@pytest.fixture(scope="module")
def careful(tmp_path_factory, keys):
    """A service that takes what our key has signed and nothing else."""
    settings = {"require_signed": True, "trusted_signers": keys["ours"][1]}
    with service(tmp_path_factory.mktemp("careful"), **settings) as api:
        yield api


def signed_by(keys, name, files, prefix=SIGNED):
    """The members with a signature of a key, made by the documentation."""
    key = serialization.load_pem_private_key(keys[name][0].read_bytes(), None)
    said = {
        "algorithm": "ed25519",
        "signer": "ed25519:" + base64.b64encode(key.public_key().public_bytes_raw()).decode(),
        "signature": base64.b64encode(key.sign(prefix + files[CHECKSUMS])).decode(),
    }
    return {**files, SIGNATURE: json.dumps(said).encode()}


def without(files, *names):
    return {name: content for name, content in files.items() if name not in names}


def test_what_is_signed_is_what_is_documented(archive, keys):
    said = json.loads(archive[SIGNATURE])
    assert (said["algorithm"], said["signer"]) == ("ed25519", keys["ours"][1])
    public = ed25519.Ed25519PublicKey.from_public_bytes(base64.b64decode(said["signer"].removeprefix("ed25519:")))
    signature = base64.b64decode(said["signature"])
    public.verify(signature, SIGNED + archive[CHECKSUMS])
    with pytest.raises(InvalidSignature):
        public.verify(signature, archive[CHECKSUMS])
    assert sorted(json.loads(archive[CHECKSUMS])) == sorted(without(archive, CHECKSUMS, SIGNATURE))


def test_who_signed_is_in_the_lineage_and_in_the_audit_log(exporter, careful, archive, keys):
    answer = send(careful, pack(archive), name="signed")
    assert answer.status_code == 201, answer.text
    assert answer.json()["lineage"]["imported"][-1]["signed_by"] == keys["ours"][1]
    added = careful.get("/v1/audit?model=signed&change=version added").json()["items"][0]
    assert added["after"]["imported"] == {"model": "arm", "version": 1, "signed_by": keys["ours"][1]}


def check_refused(api, files, message):
    answer = error(send(api, pack(files), name="refused"), 422, "invalid_data")
    assert message in answer["message"]
    assert answer["detail"][0]["field"] == SIGNATURE
    assert api.get("/v1/models/refused").status_code == 404


def test_where_a_signature_is_required_an_archive_without_one_is_refused(careful, archive, keys):
    message = "signature.json is missing, expected the signature of a signer of LIPSERVE_TRUSTED_SIGNERS"
    check_refused(careful, without(archive, SIGNATURE), message)


def test_where_a_signature_is_required_a_stranger_is_refused(careful, archive, keys):
    check_refused(careful, signed_by(keys, "theirs", archive), f"signature.json is of {keys['theirs'][1]}")


def test_elsewhere_an_archive_without_a_signature_is_taken_and_so_is_a_stranger(exporter, archive, keys):
    made = send(exporter, pack(without(archive, SIGNATURE)), name="unsigned")
    assert "signed_by" not in made.json()["lineage"]["imported"][-1]
    made = send(exporter, pack(signed_by(keys, "theirs", archive)), name="of-a-stranger")
    assert made.json()["lineage"]["imported"][-1]["signed_by"] == keys["theirs"][1]


def broken(archive, keys, other):
    said = json.loads(archive[SIGNATURE])
    flipped = bytearray(base64.b64decode(said["signature"]))
    flipped[5] ^= 1
    foreign = {**said, "signer": keys["theirs"][1]}
    tensors = bytearray(archive[TENSORS])
    tensors[-1] ^= 1
    about = json.loads(archive[EXPORT])
    renamed = json.dumps({**about, "model": "renamed"}).encode()
    return {
        "another signature": {**archive, SIGNATURE: as_json(said, signature=base64.b64encode(flipped).decode())},
        "the name of another": {**archive, SIGNATURE: json.dumps(foreign).encode()},
        "tensors with sums of their own": {**vouched(without({**archive, TENSORS: bytes(tensors)}, SIGNATURE))},
        "another model": {**other, SIGNATURE: archive[SIGNATURE]},
        "another name": vouched(without({**archive, EXPORT: renamed}, SIGNATURE)),
        "sums in other words": {**archive, CHECKSUMS: archive[CHECKSUMS] + b" "},
        "of something else": signed_by(keys, "ours", archive, b""),
        "a point of small order": {
            **archive,
            SIGNATURE: as_json(said, signer="ed25519:" + base64.b64encode(bytes(32)).decode()),
        },
    }


def as_json(said, **changes):
    return json.dumps({**said, **changes}).encode()


CASES = (
    *("another signature", "the name of another", "tensors with sums of their own", "another model"),
    *("another name", "sums in other words", "of something else", "a point of small order"),
)


@pytest.mark.parametrize("case", CASES)
def test_a_broken_signature_is_refused_whether_one_is_required_or_not(exporter, careful, archive, keys, case):
    cases = broken(archive, keys, unpack(exported(exporter, "other")))
    assert set(cases) == set(CASES)
    files = {SIGNATURE: archive[SIGNATURE], **cases[case]}
    for api in (exporter, careful):
        check_refused(api, files, "signature.json is broken")


def test_what_a_signature_does_not_cover_is_refused_by_its_checksum(careful, archive):
    """The signature is right, and the file is another."""
    for name in (MANIFEST, TENSORS, EXPORT):
        answer = error(
            send(careful, pack({**archive, name: archive[name] + b" "}), name="refused"), 422, "invalid_data"
        )
        assert name in answer["message"]
    extra = {**archive, "robot.urdf": b"<robot/>"}
    assert CHECKSUMS in error(send(careful, pack(extra), name="refused"), 422, "invalid_data")["message"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"algorithm": "none"}, "algorithm"),
        ({"algorithm": None}, "algorithm"),
        ({"signer": "ed25519:short"}, "signer"),
        ({"signer": ["ed25519:" + "A" * 43 + "="]}, "signer"),
        ({"signature": ""}, "signature"),
        ({"signature": "A" * 85 + "-=="}, "signature"),
        ({"more": 1}, "more"),
    ],
)
def test_a_signature_of_another_form_is_refused_by_name(exporter, archive, change, field):
    said = as_json(json.loads(archive[SIGNATURE]), **change)
    answer = error(send(exporter, pack({**archive, SIGNATURE: said}), name="refused"), 422, "invalid_data")
    assert f"{SIGNATURE}.{field}" in answer["message"]


def test_a_service_without_the_package_takes_no_signed_archive(exporter, archive, monkeypatch):
    monkeypatch.setattr(signing, "find_spec", lambda name: None)
    check_refused(exporter, archive, "pip install 'lipserve[signing]'")
    with pytest.raises(ValueError, match=r"LIPSERVE_SIGNING_KEY_FILE is set, which needs .* 'lipserve\[signing\]'"):
        create_app(exporter.app.state.storage.settings)


def test_a_key_that_cannot_sign_keeps_the_service_from_starting(tmp_path, keys):
    secret = tmp_path / "key"
    rsa_key = rsa.generate_private_key(65537, 2048)
    form = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8)
    locked = ed25519.Ed25519PrivateKey.generate()
    wrong = {
        "no key": b"secret words",
        "of another kind": rsa_key.private_bytes(*form, serialization.NoEncryption()),
        "with a password": locked.private_bytes(*form, serialization.BestAvailableEncryption(b"word")),
    }
    for payload in wrong.values():
        secret.write_bytes(payload)
        with pytest.raises(signing.SigningKeyError, match="expected a private ed25519 key in PEM") as refused:
            create_app(Settings(home=tmp_path / "home", signing_key_file=secret))
        assert "secret words" not in str(refused.value)
    with pytest.raises(signing.SigningKeyError, match="cannot be read: No such file"):
        create_app(Settings(home=tmp_path / "home", signing_key_file=tmp_path / "none"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"require_signed": True}, "expected trusted_signers too"),
        ({"trusted_signers": "ed25519:AAAA"}, "trusted_signers"),
        ({"trusted_signers": "rsa:" + "A" * 43 + "="}, "trusted_signers"),
    ],
)
def test_settings_that_could_not_be_met_are_refused(settings, message):
    with pytest.raises(ValidationError, match=message):
        Settings(**settings)


def test_several_signers_are_separated_by_commas(keys):
    both = [signer for _, signer in keys.values()]
    assert Settings(trusted_signers=" , ".join(both)).signers == tuple(both)


def test_the_command_makes_a_key_and_shows_its_public_part(lipserve, tmp_path):
    file = tmp_path / "key.pem"
    code, signer, _ = lipserve("keys", "signing", file)
    assert code == 0
    assert file.stat().st_mode & 0o777 == 0o600
    assert Settings(trusted_signers=signer.strip()).signers == (signer.strip(),)
    before = file.read_bytes()
    assert lipserve("keys", "signing", file)[:2] == (0, signer)
    assert json.loads(lipserve("keys", "signing", file, "--json")[1]) == {"signer": signer.strip(), "made": False}
    assert file.read_bytes() == before
    assert "PRIVATE" not in signer
    file.write_text("no key")
    code, _, err = lipserve("keys", "signing", file)
    assert code == 1
    assert "expected a private ed25519 key" in err
