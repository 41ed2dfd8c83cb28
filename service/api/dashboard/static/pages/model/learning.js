// Online learning of a model: state, recent quality, alarms, settings.

import { get } from "../../api.js";
import { Badge, Card, Empty, ErrorBox, Facts, Link, Loading, Table, Term, useRead } from "../../components.js";
import { ago, count, counted, number, percent, scientific, seconds, sentence, shortNames, when } from "../../format.js";
import { Joint } from "../../jointbars.js";
import { html } from "../../preact.js";

/** The tab, updated every five seconds. */
export function Learning({ where, model: { name, serving_version: serving } }) {
  if (serving === null) return html`<${Empty} text="No version is serving, so nothing is learnt online." />`;
  return html`<${Shown} where=${where} name=${name} />`;
}

function Shown({ where, name }) {
  const { value, error, reload } = useRead((signal) => Promise.all([
    get(`${where}/learning`, {}, signal), get(`${where}/quality`, {}, signal), get(`${where}/alarms`, { limit: 5 }, signal),
  ]), [where], 5);
  if (!value) return error ? html`<${ErrorBox} error=${error} retry=${reload} />` : html`<${Loading} />`;
  const [state, quality, alarms] = value;
  return html`
    ${error && html`<p class="banner bad" role="alert">Out of date. ${sentence(error.message)} Retrying.</p>`}
    <${State} ...${state} name=${name} /><${Quality} ...${quality} /><${Alarms} alarms=${alarms.items} /><${Settings} settings=${state.options} />`;
}

function State({ options, status: at, name }) {
  const live = html`<${Link} to=${`#/live/${encodeURIComponent(name)}`} kind="primary">Follow live<//>`;
  if (!at.events) return html`<${Empty} text=${options.enabled ? "Nothing learnt online yet. Send measured torque by a stream or in observation batches." : "Learning is paused."}>${live}<//>`;
  const pairs = [
    ["Learning version", String(at.version)],
    [html`Serving <${Term} of="revision">revision<//>`, html`${count(at.published)} ${at.lag_events ? html`<${Badge} state=${`${counted(at.lag_events, "event")} behind`} kind="busy" />` : html`<${Badge} state="up to date" kind="good" />`}`],
    ["Observation batches logged", count(at.events)],
    ["Rows outside the training data", percent(at.novel_share)],
    ...(at.linearisation_error ? [[html`<${Term} of="linearisation">Linearisation<//> error of the arm`, `${percent(Math.max(...at.linearisation_error))} of the stated standard deviation`]] : []),
    ["Streams", at.streams.length ? at.streams.map((each) => each.stream_id).join(", ") : "none"],
  ];
  return html`<${Card} title="State">
    ${at.held && html`<p class="banner bad" role="note"><strong>Learning is paused.</strong> The robot may have changed${at.held.at ? ` ${ago(at.held.at)}` : ""}. Decide on the live page whether to adapt the model.</p>`}
    ${at.failure && html`<p class="banner bad" role="note">Learning failed: ${at.failure}</p>`}
    <${Facts} pairs=${pairs} /><p>${live}</p>
  <//>`;
}

function Quality({ joint_names: names, windows, level }) {
  const newest = windows.find((each) => each.rows);
  if (!newest) return null;
  const short = shortNames(names);
  const columns = [
    { label: "Joint", cell: (joint) => html`<${Joint} index=${joint} name=${short[joint]} />` },
    { label: "nMSE", term: "nmse", numeric: true, cell: (joint) => scientific(newest.nmse[joint]) },
    { label: "RMSE, N·m", term: "rmse", numeric: true, cell: (joint) => number(newest.rmse[joint]) },
    { label: `${percent(level, 0)} coverage`, term: "coverage", numeric: true, cell: (joint) => percent(newest.coverage[joint]) },
  ];
  const rejected = Object.entries(newest.rejected).filter(([, rows]) => rows).map(([code, rows]) => `${code} ${count(rows)}`);
  return html`<${Card} title="Recent quality">
    <${Table} columns=${columns} rows=${names.map((_name, joint) => joint)} caption=${`The last ${count(newest.seconds)} s, ${counted(newest.rows, "row")}, predicted before they were learnt`} />
    <p class="hint">${count(newest.accepted)} of these rows were learnt${rejected.length ? `; rejected: ${rejected.join(", ")}` : ""}.</p>
  <//>`;
}

const ALARM_COLUMNS = [
  { label: "Time", cell: (each) => when(each.at) },
  { label: "Kind", cell: (each) => html`<${Badge} state=${each.kind} kind=${each.kind === "change" ? "bad" : "plain"} />` },
  { label: "Message", cell: (each) => each.message },
];

function Alarms({ alarms }) {
  return alarms.length > 0 && html`<${Card} title="Recent alarms"><${Table} columns=${ALARM_COLUMNS} rows=${alarms} /><//>`;
}

const yes = (value) => (value ? "yes" : "no");
const duration = (value) => (value === null ? "none" : seconds(value));
const SETTINGS = {
  enabled: ["Learning", (value) => (value ? "enabled" : "paused")],
  on_change: ["When the robot changes", (value) => ({ hold: "pause learning", adapt: "adapt", learn: "continue learning" })[value] ?? value],
  forgetting_s: ["Forgetting time", duration],
  friction_walk_s: ["Friction drift time", duration],
  torque_limits: ["Torque limits, N·m", (value) => value?.join(", ") ?? "none"],
  contact_threshold: ["Contact threshold", (value) => `${number(value)} σ`],
  adaptive_intervals: ["Adaptive intervals", yes],
  payloads: ["Payload estimation", yes],
  auto_refresh: ["Automatic retraining", yes],
  auto_promote: ["Automatic promotion", yes],
};

function Settings({ settings }) {
  const pairs = Object.entries(SETTINGS).map(([key, [label, text]]) => [label, text(settings[key])]);
  return html`<${Card} title="Settings"><${Facts} pairs=${pairs} /><p class="hint">The first three can be changed on the live page, all of them through the API.</p><//>`;
}
