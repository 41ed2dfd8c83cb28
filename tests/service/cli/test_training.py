"""`lipserve train`, `jobs`, `evaluate` and `predict`."""

import json
import threading
from contextlib import nullcontext

import numpy as np
import pytest

from lipserve import ApiError, Client, ServiceUnreachableError
from service.cli import connecting
from tests.service.cli.conftest import QUICKLY, lacking, options_of_train
from tests.service.data import ENDLESS, columns, csv, ended, eventually, queue, stream, upload
from tests.service.server import Server, free_port

ENDLESSLY = options_of_train(ENDLESS)


def test_train_evaluate_and_predict_from_a_recording(run_command, server, recording):
    path = recording(11, samples=120, rate=10.0)
    types = ("--joint-types", "revolute, revolute", "--hold-out", 0.25, "--hold-out-by", "blocks")
    text = run_command("train", path, "--model", "from-cli", *types, *QUICKLY)
    version = server.client.get("/v1/models/from-cli/versions/1").json()
    held = version["lineage"]["holdout"]
    assert (held["split"]["kind"], held["split"]["share"]) == ("blocks", 0.25)
    low, high = (f"{100 * held[f'coverage_{bound}'][0]:.0f} %" for bound in ("low", "high"))
    parts = (
        "from-cli version 1 trained: now serving",
        f"{held['samples']} held-out samples",
        f"{held['rmse'][1]:.2g} N·m",
        f"{low} to {high}",
        version["verdict"]["label"],
    )
    assert lacking(text, *parts) == []

    dataset = held["datasets"][0]["id"]
    text = run_command("evaluate", "from-cli", dataset, "--held-out")
    assert lacking(text, f"on {held['samples']} held-out samples of {dataset}", f"{held['rmse'][0]:.2g} N·m") == []
    assert run_command("evaluate", "from-cli", dataset, "--json")["part"] == "all"
    assert "training data: figures are too optimistic" in run_command("evaluate", "from-cli", dataset)
    assert not run_command("evaluate", "from-cli", recording(83), "--json")["in_training"]

    answer = run_command("predict", "from-cli", "--q", "0.1,-0.2", "--json")
    query = {"q": [0.1, -0.2], "dq": [0.0, 0.0], "ddq": [0.0, 0.0]}
    assert answer == server.client.post("/v1/models/from-cli/predict", json=query).json()
    text = run_command("predict", "from-cli", "--q", "0.1,-0.2")
    assert lacking(text, "joint1", f"{answer['tau'][1]:.4f}") == []


def test_components_are_printed(run_command, run_rejected_command, server):
    q, names = [0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.7], ["gravity", "inertia_matrix", "potential_energy"]
    query = {"q": q, "dq": [0.0] * 7, "ddq": [0.0] * 7, "components": names}
    expected = server.client.post("/v1/models/panda-sim/predict", json=query).json()["components"]
    command = ("predict", "panda-sim", "--q", ",".join(map(str, q)), "--components", ", ".join(names))
    gravity, inertia, energy = (expected[name] for name in names)
    figures = (
        f"{gravity['mean'][1]:.4f} ± {gravity['std'][1]:.4f}",
        f"{inertia['mean'][2][3]:.4f} ± {inertia['std'][2][3]:.4f}",
        f"{energy['mean']:.4f}",
    )
    assert lacking(run_command(*command), *figures) == []
    assert run_command(*command, "--json")["components"] == expected
    assert "`tau` is used only for forward_dynamics" in run_rejected_command(*command, "--tau", "0,0,0,0,0,0,0")


def test_predict_with_payload_options(run_command, run_rejected_command, server):
    inertia = [[0.02, 0.001, 0.002], [0.001, 0.03, 0.003], [0.002, 0.003, 0.04]]
    payload = {"mass": 2.0, "com": [0.0, 0.01, 0.1], "inertia": inertia}
    query = {"q": [0.1] * 7, "dq": [0.0] * 7, "ddq": [1.0] * 7, "payload": payload}
    expected = server.client.post("/v1/models/panda-sim/predict", json=query).json()
    motion = ("--q", ",".join(["0.1"] * 7), "--ddq", ",".join(["1"] * 7))
    command = ("predict", "panda-sim", *motion, "--payload", "2,0,0.01,0.1")
    assert run_command(*command, "--payload-inertia", "0.02,0.001,0.002,0.03,0.003,0.04", "--json") == expected
    assert run_command(*command, "--json")["tau"] != expected["tau"]
    text = run_rejected_command(*command, "--payload-inertia", "1,0,0,1,0,3")
    assert "expected no principal moment above the sum of the other two" in text


def test_errors_of_the_service_are_printed(run_rejected_command, tmp_path):
    message, hint = run_rejected_command("predict", "nobody", "--q", "1").splitlines()
    assert message == "error: no model 'nobody' (not_found, 404)"
    assert hint.startswith("hint: existing models: ")
    assert "panda-sim" in hint
    bad = tmp_path / "bad.csv"
    bad.write_text("t,q1,speed1\n0,0,0\n")
    assert "column tau1 is missing" in run_rejected_command("train", bad, "--model", "m")


WRONG = {
    "--estimator is nope": ("--estimator", "nope"),
    "--hold-out is 3.0": ("--hold-out", 3),
    "--hold-out above 0": ("--hold-out", 0, "--hold-out-only"),
    "--hold-out-by is rows": ("--hold-out-by", "rows"),
    "--robot is pandda": ("--robot", "pandda"),
    "--robot is 'no.urdf'": ("--robot", "no.urdf"),
    "`--robot` is not used by estimator lip": ("--robot", "panda", "--estimator", "lip"),
    "--option starts is 0": ("--option", "starts=0"),
    "--promotion is never": ("--promotion", "never"),
    "no model 'nobody'": ("--base", "nobody"),
    "no dataset 'gone.csv'": ("gone.csv",),
    "--model is Never!": ("--model", "Never!"),
}


@pytest.mark.parametrize("message", WRONG)
def test_rejected_training_uploads_nothing(run_rejected_command, server, recording, message):
    before = server.client.get("/v1/datasets", params={"limit": 1}).json()["items"]
    assert message in run_rejected_command("train", recording(13), "--model", "never", *WRONG[message])
    assert server.client.get("/v1/datasets", params={"limit": 1}).json()["items"] == before


def test_job_draft_is_checked_and_not_queued(server):
    dataset = upload(server.client, stream())["id"]
    before = server.client.get("/v1/jobs", params={"limit": 1}).json()["items"]
    for datasets in ([], [dataset]):
        answer = server.client.post("/v1/jobs/check", json={"model": "draft", "datasets": datasets})
        assert (answer.status_code, answer.content) == (204, b"")
    held = {"model": "draft", "datasets": [dataset], "joint_types": ["revolute"]}
    answer = server.client.post("/v1/jobs/check", json=held).json()["error"]
    assert answer["detail"][0]["field"] == "joint_types"
    assert server.client.get("/v1/jobs", params={"limit": 1}).json()["items"] == before


def test_job_stores_ids_of_data_sets_given_by_name(server):
    made = upload(server.client, stream(seed=14), name="named for a job")["id"]
    job = queue(server.client, "cli-by-name", "named for a job", estimator="se")
    assert job["datasets"] == [made]
    assert ended(server.client, job["id"])["state"] == "succeeded"


@pytest.mark.slow
def test_error_for_other_joint_names_has_a_hint(run_command, run_rejected_command, tmp_path):
    path, two = tmp_path / "numbered.csv", tmp_path / "two.csv"
    path.write_bytes(csv(columns(stream("panda", 40, seed=15))))
    two.write_bytes(csv(columns(stream(seed=16))))
    parts = (
        "are joint1, joint2",
        "those of the model are panda_joint1, panda_joint2",
        "If they are the same joints, upload the recording with --robot panda. (invalid_request",
    )
    assert lacking(run_rejected_command("evaluate", "panda-sim", path), *parts) == []
    assert "same joints" not in run_rejected_command("evaluate", "panda-sim", two)
    robot = ("--robot", "panda")
    answer = run_command("evaluate", "panda-sim", path, *robot, "--json")
    assert answer["joint_names"] == list(stream("panda", 40, seed=15).joint_names)
    message = run_rejected_command("evaluate", "panda-sim", answer["dataset"], *robot)
    assert "--robot can only be used with a recording" in message


@pytest.fixture
def interrupted(monkeypatch):
    """Press Ctrl-C when the job is first shown."""

    def look(job):
        raise KeyboardInterrupt

    monkeypatch.setattr("lipserve.progress.job_bar", lambda console: nullcontext(look))


@pytest.fixture(scope="module")
def long(server):
    """Data set for which a fit with the options ENDLESS takes half a minute."""
    return upload(server.client, stream("panda", 200, seed=81))["id"]


def test_ctrl_c_in_train_cancels_the_job(run_on_server, long, interrupted):
    code, out, err = run_on_server("train", long, "--model", "cli-cut", *ENDLESSLY, "--json")
    job = json.loads(out)
    assert (code, job["state"]) == (130, "cancelled")
    assert f"{job['id']} is cancelled" in err


def test_ctrl_c_before_the_answer_cancels_the_job(run_on_server, server, long, monkeypatch):
    """Ctrl-C comes before the answer is read: the job exists, but its id is unknown."""
    send, interruptions = Client.send, iter([KeyboardInterrupt])

    def cut(client, call):
        answer = send(client, call)
        if (call.method, call.path) == ("POST", "/v1/jobs") and (interruption := next(interruptions, None)):
            raise interruption
        return answer

    monkeypatch.setattr(Client, "send", cut)
    assert run_on_server("train", long, "--model", "cli-torn", *ENDLESSLY)[:2] == (130, "")
    (torn,) = jobs_of(server, "cli-torn")
    assert ended(server.client, torn)["state"] == "cancelled"


def jobs_of(server, model):
    return [job["id"] for job in server.client.get("/v1/jobs").json()["items"] if job["model"] == model]


def test_ctrl_c_in_follow_does_not_cancel_the_job(run_on_server, run_command, server, long, interrupted):
    job = queue(server.client, "cli-left", long, options=ENDLESS)["id"]
    code, out, err = run_on_server("jobs", "follow", job, "--json")
    assert (code, json.loads(out)["state"] in ("queued", "running")) == (130, True)
    assert f"{job} continues" in err
    assert run_command("jobs", "cancel", job, "--json")["id"] == job


@pytest.mark.slow
def test_job_is_queued_followed_and_listed(run_rejected_command, run_command, recording):
    options = ("--no-wait", *QUICKLY, "--estimator", "se", "--json")
    job = run_command("train", recording(82), "--model", "cli-queued", *options)["id"]
    assert "cli-queued (se): succeeded, version 1" in run_command("jobs", "follow", job)
    assert run_command("jobs", "show", job, "--json")["state"] == "succeeded"
    assert job in [each["id"] for each in run_command("jobs", "list", "--json")]
    assert "cli-queued" in run_command("jobs", "list")
    assert "conflict" in run_rejected_command("jobs", "retry", job)


@pytest.mark.slow
def test_hold_out_defaults_to_the_service_and_zero_disables_it(run_command, server, recording):
    path = recording(12, samples=120, rate=10.0)
    job = run_command("train", path, "--model", "by-default", *QUICKLY, "--json")
    body = {"model": "by-default", "datasets": job["datasets"], "estimator": "lip-chain"}
    plain = server.client.post("/v1/jobs", json=body).json()
    server.client.post(f"/v1/jobs/{plain['id']}/cancel")
    assert job["holdout"] == {**plain["holdout"], "stretches": None, "only": False}
    assert (job["holdout"]["kind"], job["holdout"]["share"]) == ("auto", 0.3)
    assert job["verdict"]["joints"]
    job = run_command("train", path, "--model", "by-default", *QUICKLY, "--hold-out", 0, "--json")
    assert (job["holdout"], job["verdict"]["level"]) == (None, "not_judged")


@pytest.mark.slow
def test_hold_out_only_data_are_never_learnt(run_command, server, recording):
    command = ("train", recording(18, samples=120, rate=10.0), "--model", "cli-only", *QUICKLY)
    assert "Evaluated on held-out rows; the version was then trained on all rows." in run_command(*command)
    assert "Evaluated on" not in run_command(*command, "--hold-out-only")
    for number, learnt in ((1, True), (2, False)):
        lineage = server.client.get(f"/v1/models/cli-only/versions/{number}").json()["lineage"]
        assert lineage["holdout"]["learnt"] is learnt
    judged = run_command("evaluate", "cli-only@1", lineage["datasets"][0]["id"], "--held-out")
    assert "evaluated before training on them" in " ".join(judged.split())


def test_job_id_is_printed_before_the_end(run_on_server, server, recording):
    code, out, err = run_on_server("train", recording(17), "--model", "cli-shown", *QUICKLY)
    assert (code, "cli-shown version 1 trained" in out) == (0, True), err
    (job,) = jobs_of(server, "cli-shown")
    queued = f"{job} is queued: `lipserve jobs follow {job}` also follows it"
    assert err.index(queued) < err.index("100 %")


@pytest.fixture
def fail_waits(monkeypatch):
    """Return a function that lets the next waits of the client raise the given errors."""

    def fail(*errors):
        wait, left = Client.wait, list(errors)

        def wait_or_fail(client, *arguments):
            if left:
                raise left.pop(0)
            return wait(client, *arguments)

        monkeypatch.setattr(Client, "wait", wait_or_fail)

    return fail


GONE = ServiceUnreachableError("gone")


def test_train_waits_for_an_unreachable_service(run_on_server, recording, fail_waits, monkeypatch):
    fail_waits(GONE, ApiError(503, "not_ready", "starting", []))
    monkeypatch.setattr(connecting, "PAUSE", 0.0)
    code, out, err = run_on_server("train", recording(18), "--model", "cli-away", *QUICKLY)
    assert (code, "cli-away version 1 trained" in out) == (0, True), err
    parts = ("continues when the service is back: waiting up to 300 s", "the service is reachable again")
    assert lacking(err, *parts) == []


FOLLOW_AGAIN = "run `lipserve jobs follow {job}` when the service is back"


@pytest.mark.parametrize(
    ("failure", "options", "parts"),
    [
        (GONE, ("--patience", 0), ("error: the service has been unreachable for 0 s", FOLLOW_AGAIN)),
        (ApiError(403, "forbidden", "this key may not", []), (), ("error: this key may not (forbidden, 403)",)),
    ],
    ids=["patience ends", "forbidden"],
)
def test_error_that_ends_following_is_printed(run_on_server, server, arm, fail_waits, failure, options, parts):
    job = server.client.get("/v1/jobs").json()["items"][0]["id"]
    fail_waits(failure)
    code, _, err = run_on_server("jobs", "follow", job, *options)
    assert (code, lacking(err, *(part.format(job=job) for part in parts))) == (1, [])


@pytest.mark.slow
def test_training_is_followed_over_a_restart(lipserve, tmp_path, recording):
    """The service is killed while the job runs, and restarts at the same address."""
    port = free_port()
    first = Server(tmp_path / "home", port=port)
    started = []

    def find_running_job():
        jobs = first.client.get("/v1/jobs").json()["items"]
        return next((job["id"] for job in jobs if job["state"] == "running"), None)

    def restart():
        job = eventually(find_running_job)
        first.kill()
        started.extend([job, Server(tmp_path / "home", port=port)])

    path = recording(19, robot="panda", samples=100)
    options = options_of_train({**ENDLESS, "max_iterations": 60})
    restarting = threading.Thread(target=restart)
    restarting.start()
    try:
        code, out, err = lipserve("train", path, "--model", "cli-over", *options, "--url", first.url)
    finally:
        restarting.join()
    job, second = started
    with first, second:
        assert (code, f"{job} is queued" in err, "cli-over version 1 trained" in out) == (0, True, True), err
        assert second.client.get(f"/v1/jobs/{job}").json()["attempts"] == 2


def test_train_prints_the_warnings_of_the_recording(run_command, run_on_server, tmp_path):
    motion = stream(seed=17, samples=120, rate=10.0)
    motion.tau[10:30, 0] = np.nan
    path = tmp_path / "gaps.csv"
    path.write_bytes(csv(columns(motion)))
    warning = "20 of 120 rows lack a value and were dropped"
    assert warning in run_command("data", "add", path)
    assert warning in run_on_server("train", path, "--model", "of-gaps", *QUICKLY)[2]
