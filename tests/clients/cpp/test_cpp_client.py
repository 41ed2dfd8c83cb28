"""C++ client against the service: answers, API keys, sockets, and a service that is killed and restarted."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

import lipcore
from lipcore.data.motion import Motion
from lipcore.model import dynamics
from service.api.access import keys
from service.foundation.settings import Settings
from service.storage.database import Database
from tests.clients.cpp.building import CPP, built, checked, here, sanitizers
from tests.clients.cpp.driver import Driver
from tests.docs.blocks import ROOT
from tests.service.data import DEADLINE, eventually
from tests.service.server import Server, free_port
from tests.service.streams import logged_rows

FAR = f"{DEADLINE:g}"
PANDA = {"model": "panda-sim"}


def panda_rows(count: int, seed: int = 0) -> np.ndarray:
    """Return distinct motions and torques (N, 4, 7) of a Panda."""
    made = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 4, 7))
    made[:, 0] += [0.0, -0.1, 0.0, -1.8, 0.2, 1.6, 0.3]
    return made


@pytest.fixture(scope="module")
def panda() -> lipcore.TorqueModel:
    return lipcore.load(ROOT / "models/panda-sim")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """Service that also listens on a Unix socket."""
    folder = tmp_path_factory.mktemp("cpp")
    with Server(folder / "home", warm=True, LIPSERVE_UDS=str(folder / "socket")) as started:
        yield started


@pytest.fixture(params=["tcp", "unix"])
def url(request, server) -> str:
    return server.url if request.param == "tcp" else f"unix://{server.home.parent}/socket"


def test_answers_match_the_model(driver, server, url, panda):
    motions = panda_rows(20)
    with Driver(driver, motions, url=url, scale=1, payload=1, rich=1, **PANDA) as client:
        report = client.do(f"connect {FAR}")
        assert (report["status"], report["first_joint"]) == ("ok", "panda_joint1")
        np.testing.assert_allclose(report["noise_std"], panda.noise_std, rtol=1e-14)
        for number, row in enumerate(motions):
            report = client.do(f"ask {number} {FAR} std")
            tau, std = panda.answer(row[:3])
            np.testing.assert_allclose(report["tau"], tau, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(report["tau_std"], std, rtol=1e-9)
            report = client.do(f"ask {number} {FAR} external")
            np.testing.assert_allclose(report["tau_external"], row[3] - tau, rtol=1e-9, atol=1e-9)
            expected = np.divide(report["tau_external"], report["tau_external_std"])
            np.testing.assert_allclose(report["tau_external_z"], expected, rtol=1e-9)
            assert (report["scale"], report["version"]) == ([1.0] * 7, 1)
            assert np.isnan(report["payload"]).all()
        assert (report["asked"], report["answered"], report["stale"], report["connections"]) == (40, 40, 0, 1)


def test_torque_without_gravity_has_its_own_deviation(driver, server, panda):
    motions = panda_rows(5)
    with Driver(driver, motions, url=server.url, without_gravity=1, **PANDA) as client:
        client.do(f"connect {FAR}")
        for number, row in enumerate(motions):
            motion = Motion(*row[:3, None])
            expected = dynamics.components(panda, motion, ["without_gravity"])["without_gravity"]
            report = client.do(f"ask {number} {FAR} std")
            np.testing.assert_allclose(report["tau"], expected.mean[0], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(report["tau_std"], expected.std[0], rtol=1e-6)
            report = client.do(f"ask {number} {FAR} external")
            np.testing.assert_allclose(report["tau_external"], row[3] - panda.answer(row[:3])[0], rtol=1e-9, atol=1e-9)


def test_parts_match_the_model_and_leave_the_last_torque(driver, server, panda):
    motions = panda_rows(3)
    with Driver(driver, motions, url=server.url, scale=1, **PANDA) as client:
        client.do(f"connect {FAR}")
        torque = client.do(f"ask 0 {FAR}")["tau"]
        for number, (q, dq, *_) in enumerate(motions):
            gravity = panda.gravity(q)
            report = client.do(f"gravity {number} {FAR}")
            np.testing.assert_allclose(report["mean"], gravity.mean, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(report["std"], gravity.std, rtol=1e-9)
            report = client.do(f"mass_matrix {number} {FAR}")
            np.testing.assert_allclose(report["mean"], panda.mass_matrix(q).ravel(), rtol=1e-12, atol=1e-12)
            report = client.do(f"coriolis {number} {FAR}")
            np.testing.assert_allclose(report["mean"], panda.coriolis(q, dq), rtol=1e-12, atol=1e-12)
            assert (report["late"], report["has_tau"], report["allocations"]) == (0, 0, 0)
        report = client.do("gravity 1 0")
        assert (report["status"], report["late"], report.get("mean")) == ("timeout", 1, None)
        report = client.do(f"ask 0 {FAR}")
        assert (report["status"], report["tau"]) == ("ok", torque)


def test_ask_with_learn_learns_after_the_answer(driver, server, panda):
    measured = panda_rows(12)
    with Driver(driver, measured, url=server.url, stream_id="asked", **PANDA) as client:
        for number, row in enumerate(measured):
            report = client.do(f"ask {number} {FAR} learn std")
            np.testing.assert_allclose(report["tau"], panda.answer(row[:3])[0], rtol=1e-9, atol=1e-9)
        assert client.do(f"flush {FAR}")["unsettled"] == 0
    logged(server, "asked", measured)


def test_control_loop_logs_every_torque_once_despite_signals(driver, server, url):
    measured, name = panda_rows(150), f"loop-{url[:4]}"
    with Driver(driver, measured, url=url, stream_id=name, alarms=1, **PANDA) as client:
        client.do(f"connect {FAR}")
        report = client.do(f"loop 150 0 {int(DEADLINE * 1e6)} 0")
        assert (report["ask_ok"], report["teach_ok"]) == (150, 150)
        assert report["alarms"] > 0
        report = client.do(f"flush {FAR}")
        assert (report["status"], report["unsettled"]) == ("ok", 0)
        assert report["accepted"] + report["rejected"] == 150
        assert (report["duplicates"], report["refused"]) == (0, 0)
    logged(server, name, measured)


def logged(server: Server, stream_id: str, expected: np.ndarray) -> None:
    """Check that the log has these rows, each once and in order."""
    found = logged_rows(server, stream_id)
    np.testing.assert_array_equal(np.stack([found.q, found.dq, found.ddq, found.tau], 1), expected)


def test_killed_service_loses_no_torque_and_logs_none_twice(driver, tmp_path):
    measured = panda_rows(450)
    settings = {"port": free_port(), "LIPSERVE_UDS": str(tmp_path / "socket")}
    settings |= {"LIPSERVE_STREAM_FLUSH_S": "0.02", "LIPSERVE_STREAM_FLUSH_ROWS": "20"}
    addresses = {"tcp": f"http://127.0.0.1:{settings['port']}", "unix": f"unix://{tmp_path}/socket"}
    server = Server(tmp_path / "home", **settings)
    with (
        Driver(driver, measured, url=addresses["tcp"], stream_id="tcp", **PANDA) as tcp,
        Driver(driver, measured, url=addresses["unix"], stream_id="unix", **PANDA) as unix,
    ):
        with server:
            for client in (tcp, unix):
                assert client.do(f"connect {FAR}")["status"] == "ok"
                client.do("teach 0 200")
                assert client.do(f"flush {FAR}")["through"] == 200
            for client in (tcp, unix):  # on its way when the service dies
                assert client.do("teach 200 260")["status"] == "ok"
            server.kill()
        for client in (tcp, unix):
            eventually(lambda client=client: client.do("ask 0 0.005")["status"] == "unreachable")
            report = client.do("teach 260 400")
            assert report["status"] == "ok"
            assert report["unsettled"] >= 140
        with Server(tmp_path / "home", **settings) as server:
            for name, client in (("tcp", tcp), ("unix", unix)):
                assert client.do(f"flush {FAR}")["status"] == "ok"
                assert client.do(f"ask 3 {FAR}")["status"] == "ok"
                client.do("teach 400 450")
                report = client.do(f"flush {FAR}")
                assert (report["taught"], report["unsettled"], report["refused"]) == (450, 0, 0)
                assert report["accepted"] + report["duplicates"] + report["rejected"] == 450
                assert (report["connections"], report["losses"]) == (2, 1)
                assert report["resent"] > 0
                logged(server, name, measured)


def test_control_loop_continues_after_a_restart(driver, tmp_path):
    measured, port = panda_rows(3000), free_port()
    server = Server(tmp_path / "home", port=port)
    with Driver(driver, measured, url=server.url, stream_id="loop", **PANDA) as client:
        with server:
            client.do(f"connect {FAR}")
            client.begin("loop 3000 0 20000 0")
            assert client.line() == "cycle\n"  # half of it is done
            server.kill()
            report = client.end()
        asked = sum(report.get(f"ask_{status}", 0) for status in ("ok", "timeout", "unreachable"))
        assert (asked, report["teach_ok"]) == (3000, 3000)
        with Server(tmp_path / "home", port=port) as server:
            report = client.do(f"flush {FAR}")
            assert (report["status"], report["unsettled"]) == ("ok", 0)
            logged(server, "loop", measured)


def test_api_keys(driver, tmp_path):
    motions = panda_rows(1)
    with Server(tmp_path / "home", warm=True, LIPSERVE_KEYS="on") as server:
        database = Database.of(Settings(home=server.home))
        _, secret = keys.create(database, "controller", ("predict",), None)
        database.close()
        bearer = {"Authorization": f"Bearer {secret}"}
        eventually(lambda: "Unknown API key" not in server.client.get("/v2", headers=bearer).text)
        refused = [
            ({}, 401, "An API key is required"),
            ({"key": "lip_of_another_service"}, 401, "Unknown API key"),
            ({"key": secret, "stream_id": "arm"}, 403, "update"),  # which teaching needs
        ]
        for options, status, words in refused:
            with Driver(driver, motions, url=server.url, **options, **PANDA) as client:
                report = client.do(f"connect {FAR}")
                assert (report["status"], report["http"]) == ("refused", status)
                assert words in report["message"]
                assert client.do("ask 0 0.001")["status"] in ("refused", "unreachable")
        environment = {"LIPSERVE_URL": server.url, "LIPSERVE_API_KEY": secret}
        for options in ({"url": server.url, "key": secret}, environment):
            with Driver(driver, motions, **options, **PANDA) as client:
                assert client.do(f"ask 0 {FAR}")["status"] == "ok"
        assert secret not in server.log.read_text()


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        ({"model": "no/such model"}, "not_found", "no/such model"),
        ({**PANDA, "version": 99}, "not_found", "99"),
        ({**PANDA, "alias": "nowhere"}, "not_found", "nowhere"),
        ({**PANDA, "stream_id": "arm 1"}, "invalid_request", "stream_id"),
    ],
)
def test_missing_models_versions_and_aliases_are_reported(driver, server, options, code, words):
    with Driver(driver, panda_rows(1), url=server.url, **options) as client:
        report = client.do(f"connect {FAR}")
        assert (report["status"], report["code"]) == ("refused", code)
        assert words in report["message"]


def test_rejected_motion_is_explained_and_the_stream_stays_open(driver, server):
    motions = panda_rows(2)
    motions[0, 0, 1] = 99.0
    with Driver(driver, motions, url=server.url, **PANDA) as client:
        report = client.do(f"ask 0 {FAR}")
        assert (report["status"], report["code"]) == ("refused", "invalid_request")
        assert "q[1]" in report["message"]
        assert client.do(f"ask 1 {FAR}")["status"] == "ok"
        report = client.do("teach 1 2")
        assert (report["status"], report["taught"]) == ("invalid", 0)
        assert "stream_id" in report["message"]


def test_sequence_of_another_motion_is_refused(driver, server):
    """A restarted controller with the stream_id of its last run does this."""
    for seed in (1, 2):
        with Driver(driver, panda_rows(3, seed), url=server.url, stream_id="again", **PANDA) as client:
            client.do("teach 0 3")
            report = client.do(f"flush {FAR}")
    assert (report["status"], report["refused"]) == ("ok", 3)
    assert "was sent before with another" in report["refusal"]
    with Driver(driver, panda_rows(3, 2), url=server.url, stream_id="again", first_sequence=4, **PANDA) as client:
        client.do("teach 0 3")
        assert client.do(f"flush {FAR}")["through"] == 6
    logged(server, "again", np.concatenate([panda_rows(3, 1), panda_rows(3, 2)]))


def test_example_runs(compiler, server, tmp_path):
    program = built(compiler, "example/controller.cpp", tmp_path, "-O1", "-g", *sanitizers(compiler))
    known = server.client.get("/v1/models/panda-sim/streams").json()
    out = checked(program, "panda-sim", "200", LIPSERVE_URL=server.url, LIPSERVE_API_KEY="")
    assert "200 cycles" in out
    assert "torques sent" not in out
    assert server.client.get("/v1/models/panda-sim/streams").json() == known
    out = checked(program, "panda-sim", "200", "teach", LIPSERVE_URL=server.url, LIPSERVE_API_KEY="")
    assert " 0 learnt" in out  # it is no measurement
    assert "0 torques not acknowledged" in out
    ran = subprocess.run(
        [program, "no-such-model"],
        capture_output=True, text=True, check=False,
        env={**os.environ, "LIPSERVE_URL": server.url},
    )  # fmt: skip
    assert ran.returncode == 1
    assert "no-such-model" in ran.stderr


def test_cmake_builds_tests_and_installs(tmp_path):
    if not here("cmake"):
        pytest.skip("cmake is not installed")
    if not here("c++", "g++", "clang++"):
        pytest.skip("no compiler of C++ is installed")

    def run(*command: str | Path) -> None:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr

    build, installed, user = tmp_path / "build", tmp_path / "installed", tmp_path / "user"
    run("cmake", "-S", CPP, "-B", build, f"-DCMAKE_INSTALL_PREFIX={installed}")
    run("cmake", "--build", build, "-j2")
    run("ctest", "--test-dir", build, "--output-on-failure")
    run("cmake", "--install", build)
    user.mkdir()
    (user / "main.cpp").write_text(
        "#include <lipserve/client.hpp>\nint main() { return lipserve::frames::layout - 1; }\n"
    )
    (user / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(user CXX)\nfind_package(lipserve-client REQUIRED)\n"
        "add_executable(user main.cpp)\ntarget_link_libraries(user PRIVATE lipserve::client)\n"
    )
    run("cmake", "-S", user, "-B", user / "build", f"-DCMAKE_PREFIX_PATH={installed}")
    run("cmake", "--build", user / "build")
    run(user / "build/user")
