// Form that starts a training job: recordings, name and robot; all else is folded.

import { pages, post } from "../api.js";
import { Await, Card, Empty, ErrorBox, Field, Heading, Link, page, useRead } from "../components.js";
import { html, useEffect, useRef, useState } from "../preact.js";
import { RobotChoice, readRobots } from "./data/robot_choice.js";
import { rowsOf } from "./data/rows.js";
import { Advanced } from "./train/advanced.js";
import { Estimators, usesRobot } from "./train/estimators.js";
import { Holdout, holdoutOf, NO_CHANGES } from "./train/holdout.js";
import { Recordings } from "./train/recordings.js";

const PROMOTION = [
  ["", "default of the service"],
  ["ask", "only if it passes the held-out check"],
  ["always", "always"],
];
const MOST = 200; // recordings and models that are listed

/** The page `#/train`; `?datasets=ID,ID&model=NAME` fills the form, `&hold_out=300-450` holds out rows of a single data set. */
function Train({ title, query }) {
  useEffect(() => title("Train a model"), []);
  const known = useRead(async (signal) => {
    const [datasets, models] = await Promise.all([pages("/v1/datasets", MOST, {}, signal), pages("/v1/models", MOST, {}, signal)]);
    return { datasets, models };
  }, []);
  return html`<${Heading} text="Train a model" />
    <${Await} reading=${known}>${(found) => (found.datasets.length ? html`<${Form} ...${found} query=${query} />` : html`<${Empty} text="No recordings yet."><${Link} to="#/data" kind="primary">Upload a recording<//><//>`)}<//>`;
}

function Form({ datasets, models, query }) {
  const given = (query.get("datasets") ?? "").split(",").filter(Boolean);
  const rows = given.length === 1 ? rowsOf(query.get("hold_out")) : null;
  const named = rows && { [given[0]]: [rows] };
  const [chosen, setChosen] = useState(given);
  const [name, setName] = useState(query.get("model") ?? newName(datasets.find((each) => each.id === given[0]), models));
  const [robot, setRobot] = useState(null); // null: that of the recordings
  const [estimator, setEstimator] = useState("auto");
  const [held, setHeld] = useState({ ...NO_CHANGES, kind: named ? "stretches" : "auto" });
  const [more, setMore] = useState({ promotion: "", base: "", joint_types: "", options: {} });
  const [opened, setOpened] = useState(Boolean(named));
  const [problem, setProblem] = useState(null), [sending, setSending] = useState(false);
  const form = useRef(null);
  const robots = useRead(readRobots, []);

  const picked = datasets.filter((each) => chosen.includes(each.id));
  const recorded = new Set(picked.map((each) => each.report.robot));
  const usual = recorded.size === 1 ? [...recorded][0] : null;
  const start = async (event) => {
    event.preventDefault();
    if (!picked.length) {
      setProblem(new Error("Choose at least one recording to train on."));
      return form.current.querySelector("[name=datasets]:not(:disabled)")?.focus();
    }
    // the select has the robot of the recordings only if that has a URDF
    const used = form.current.elements.robot;
    setSending(true);
    setProblem(null);
    try {
      const job = await post("/v1/jobs", requestOf({ name, picked, estimator, held, named, more, robot: used?.disabled ? "" : used?.value }));
      location.hash = `#/jobs/${job.id}`;
    } catch (error) {
      setSending(false);
      setProblem(error);
      focusOn(form.current, error.detail?.[0]?.field);
    }
  };
  return html`<form onSubmit=${start} onInvalidCapture=${(event) => unfold(event.target)} ref=${form} class="training">
    <${Card} title="Recordings"><${Recordings} datasets=${datasets} first=${given} chosen=${chosen} onchange=${setChosen} /><//>
    <${Card} title="Model">
      <${Name} value=${name} onchange=${setName} models=${models} />
      <${RobotChoice} reading=${robots} value=${robot ?? usual ?? ""} onchange=${setRobot} withUrdf none="none: learn the joint axes"
        disabled=${usesRobot(estimator) ? "" : `${estimator} does not start from a robot. Choose another estimator to use one.`}
        hint=${robotHint(picked, usual, robot)} />
    <//>
    <details class="card" open=${opened} onToggle=${(event) => event.target.open && setOpened(true)}>
      <summary>Options</summary>
      <p class="hint">Estimator, held-out part, serving and fit. The defaults suit most recordings.</p>
      <${Estimators} chosen=${estimator} onchoose=${setEstimator} />
      <${Holdout} value=${held} onchange=${setHeld} named=${named} />
      <${Serving} value=${more} onchange=${setMore} models=${models.filter((each) => each.name !== name)} estimator=${estimator} joints=${picked[0]?.joint_names.length} />
      ${opened && html`<${Advanced} values=${more.options} onchange=${(options) => setMore((last) => ({ ...last, options }))} />`}
    </details>
    ${problem && (problem.name === "ApiError" ? html`<${ErrorBox} error=${problem} />` : html`<p class="error" role="alert">${problem.message}</p>`)}
    <div class="actions"><button type="submit" class="primary" disabled=${sending}>${sending ? "Starting…" : "Start training"}</button></div>
  </form>`;
}

/** Return the name of a recording as that of a model; nothing if a model has that name already. */
function newName(dataset, models) {
  const name = (dataset?.name ?? "").toLowerCase().replace(/\..*/, "").replace(/[^a-z0-9_-]+/g, "-").replace(/^[^a-z0-9]+/, "").slice(0, 64);
  return models.some((each) => each.name === name) ? "" : name;
}

function Name({ value, onchange, models }) {
  const model = models.find((each) => each.name === value.trim());
  const has = model?.latest_version === 1 ? "version 1" : `versions up to ${model?.latest_version}`;
  return html`<${Field} label="Model name" hint="Lower-case letters, digits, dots, underscores and hyphens." input=${(attributes) => html`<input ...${attributes}
      type="text" name="model" value=${value} onInput=${(event) => onchange(event.target.value)} required pattern="[a-z0-9][a-z0-9._\\-]{0,63}"
      title="Lower-case letters, digits, dots, underscores and hyphens; max 64" placeholder="my-arm" autocomplete="off" autocapitalize="none" spellcheck=${false} list="models-known" />`} />
    <p class="hint" role="status" hidden=${!model}>${model && `${model.name} has ${has}. The new version serves if it passes the held-out check. Otherwise it becomes a candidate.`}</p>
    <datalist id="models-known">${models.map((each) => html`<option key=${each.name} value=${each.name} />`)}</datalist>`;
}

function Serving({ value, onchange, models, estimator, joints }) {
  const set = (name) => (event) => onchange({ ...value, [name]: event.target.value });
  const bases = models.filter((each) => each.serving_version !== null);
  const robotless = !usesRobot(estimator);
  return html`<fieldset>
    <legend>Version</legend>
    <${Field} label="Start serving the new version" hint="The held-out check requires a 95\u00a0% coverage of at least 90\u00a0% on every joint, and predictions no worse than those of the serving version."
      input=${(attributes) => html`<select ...${attributes} name="promotion" onChange=${set("promotion")}>${PROMOTION.map(([each, label]) => html`<option value=${each} selected=${each === value.promotion}>${label}</option>`)}</select>`} />
    <${Field} label="Start from another unit" hint=${robotless ? `${estimator} does not start from another version.` : "A model of another unit of the same robot. Its arm is the prior, its friction is not."}
      input=${(attributes) => html`<select ...${attributes} name="base" disabled=${robotless} onChange=${set("base")}>
        <option value="" selected=${!value.base}>none</option>
        ${bases.map((each) => [`${each.name}:${each.serving_version}`, each]).map(([address, each]) => html`<option key=${address} value=${address} selected=${address === value.base}>${each.name}, version ${each.serving_version}</option>`)}
      </select>`} />
    <${Field} label="Joint types" hint=${`revolute or prismatic for each${joints ? ` of ${joints} joints` : " joint"}, separated by commas.`}
      input=${(attributes) => html`<input ...${attributes} type="text" name="joint_types" value=${value.joint_types} onInput=${set("joint_types")} placeholder="of the robot, or revolute" autocomplete="off" />`} />
  </fieldset>`;
}

function robotHint(picked, usual, chosen) {
  if (usual && chosen === null) return "The robot of the recordings. Training starts from its URDF; joints are matched by name.";
  const fits = picked[0]?.report.remedies.find((each) => each.cause === "robot")?.options?.robot;
  return `Optional. Training then starts from the robot’s URDF; joints are matched by name.${fits ? ` The joint names fit ${fits}.` : ""}`;
}

function requestOf({ name, picked, estimator, held, named, more, robot }) {
  const request = { model: name.trim(), datasets: picked.map((each) => each.id), estimator, options: more.options, holdout: holdoutOf(held, named) };
  if (more.promotion) request.promotion = more.promotion;
  request.robot = robot || null; // null: none, also if the recordings have one
  if (more.base && usesRobot(estimator)) request.base = more.base;
  const types = more.joint_types.split(",").map((each) => each.trim()).filter(Boolean);
  if (types.length) request.joint_types = types;
  return request;
}

function focusOn(form, path) {
  const wrong = path && form.querySelector(`[name="${CSS.escape(path.replace(/\[.*/, ""))}"]`);
  if (!wrong) return;
  unfold(wrong);
  wrong.focus();
}

/** Open what hides a field: the browser cannot show its message there. */
function unfold(field) {
  field.closest("details:not([open])")?.setAttribute("open", "");
}

export const render = page(Train);
