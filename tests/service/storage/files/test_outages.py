"""An unreachable shared store: callers that need it fail in time, and files with a local copy can still be read."""

import errno
import os
import pickle
import threading
from unittest.mock import Mock

import pytest

from service.foundation.errors import StorageFullError, StorageUnavailableError
from service.foundation.settings import Settings
from service.storage import errors as storage_errors
from service.storage.files import Files, FilesUnreachableError, objects
from service.storage.storage import HomeError, check_home
from tests.service.storage.files.conftest import put

pytestmark = pytest.mark.slow  # needs S3


def error_messages(files):
    """Return the errors of all operations that need the store."""
    messages = []
    for operation in (
        lambda: put(files, "ds_two"),
        lambda: files.samples_file("ds_else", "0" * 64),
        lambda: files.read_snapshot("snap_else"),
        lambda: files.load_version("mv_else", None),
        lambda: files.versions_marked("job"),
        lambda: files.sweep(set(), set(), set()),
        files.check,
    ):
        with pytest.raises(FilesUnreachableError) as caught:
            operation()
        messages.append(str(caught.value))
    return messages


@pytest.fixture
def single_attempt(monkeypatch):
    """Let the S3 library send each request once, without its pauses."""
    pytest.importorskip("s3fs")
    from service.storage.files import bucket

    monkeypatch.setattr(bucket, "BUCKET", bucket.BucketOptions(attempts=1))


def test_unreachable_endpoint_is_detected_and_its_return_too(s3, bucket, tmp_path, single_attempt):
    files = Files(tmp_path, bucket)
    digest = put(files)
    s3.stop()
    try:
        assert all("does not answer" in each for each in error_messages(files))
        assert files.samples_file("ds_one", digest).exists()
        files.delete_dataset("ds_one")  # the copy is swept later
    finally:
        s3.start()
    assert Files(tmp_path / "other", bucket).samples_file("ds_one", digest).exists()
    put(files, "ds_two")


def test_missing_bucket_does_not_make_data_lost(bucket, tmp_path, single_attempt):
    assert all("bucket" in each for each in error_messages(Files(tmp_path, "s3://nobody-has-this/files")))


def test_unmounted_folder_is_not_created(tmp_path):
    root = tmp_path / "mounted"
    assert all("is it mounted?" in each for each in error_messages(Files(tmp_path / "home", root.as_uri())))
    assert not root.exists()


@pytest.fixture
def fail_requests(monkeypatch):
    """Return a function that lets a request of the S3 library fail."""

    def fail(files, name, error):
        monkeypatch.setattr(files._place.objects._system, name, Mock(side_effect=error))

    return fail


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        (PermissionError("User: arn:secret is not allowed"), "access is denied"),
        (TimeoutError(), "in time"),
        (OSError(errno.EIO, "Reduce your rate"), "rejects the request"),
    ],
)
def test_bucket_error_is_reported_without_secrets(bucket, tmp_path, fail_requests, raised, words):
    files = Files(tmp_path, bucket)
    fail_requests(files, "put_file", raised)
    with pytest.raises(FilesUnreachableError, match=words) as caught:
        put(files)
    assert "secret" not in str(caught.value)


def test_full_cache_disk_is_reported(bucket, tmp_path, fail_requests):
    digest = put(Files(tmp_path / "one", bucket))
    files = Files(tmp_path / "other", bucket)
    fail_requests(files, "get_file", OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    with pytest.raises(OSError, match="No space left") as caught:
        files.samples_file("ds_one", digest)
    assert isinstance(storage_errors.translate_error(caught.value), StorageFullError)


def test_missing_credentials_are_reported(bucket, tmp_path, monkeypatch):
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(FilesUnreachableError, match="AWS_ACCESS_KEY_ID"):
        Files(tmp_path, bucket).check()


def test_clients_get_503_and_retry_after(tmp_path):
    with pytest.raises(FilesUnreachableError) as caught:
        Files(tmp_path / "home", (tmp_path / "gone").as_uri()).check()
    translated = storage_errors.translate_error(caught.value)
    assert isinstance(translated, StorageUnavailableError)
    assert translated.headers == storage_errors.RETRY_AFTER
    again = pickle.loads(pickle.dumps(caught.value))  # a worker on another host reports it too
    assert (type(again), again.strerror) == (FilesUnreachableError, caught.value.strerror)


def test_patient_caller_waits_for_the_store(tmp_path, monkeypatch):
    monkeypatch.setattr(objects, "FIRST_PAUSE_S", 0.01)
    root = tmp_path / "mounted"
    files = Files(tmp_path / "home", root.as_uri(), patience_s=30.0)
    warned = threading.Event()
    monkeypatch.setattr(objects.logger, "warning", lambda *_: warned.set())
    mount = threading.Thread(target=lambda: warned.wait(30.0) and root.mkdir())
    mount.start()
    digest = put(files)
    mount.join()
    assert Files(tmp_path / "other", root.as_uri()).samples_file("ds_one", digest).exists()


@pytest.mark.parametrize("url", ["s3://nobody-has-this/files", "file:///nobody/has/this"])
def test_service_does_not_start_without_its_store(url, s3, bucket, tmp_path, single_attempt):
    settings = Settings(home=tmp_path, database_url="postgresql://nowhere/none", files_url=url)
    with pytest.raises(HomeError, match=f"files_url is '{url}'"):
        check_home(settings)
