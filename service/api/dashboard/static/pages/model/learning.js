// Online learning of a model: state, recent quality, alarms, settings.

import { get } from "../../api.js";
import { h, refresh, replace } from "../../dom.js";
import { ago, count, counted, number, percent, scientific, seconds, sentence, shortNames, when } from "../../format.js";
import { badge, card, empty, facts, link, loading, repeat, table } from "../../ui.js";

/** Draw the tab and update it every five seconds. */
export async function learning(view, { where, name }, { signal }) {
  const stale = h("div", {}), place = h("div", {}, loading());
  replace(view, stale, place);
  let seen = "";
  const update = async () => {
    const [state, quality, alarms] = await Promise.all([
      get(`${where}/learning`, {}, signal),
      get(`${where}/quality`, {}, signal),
      get(`${where}/alarms`, { limit: 5 }, signal),
    ]);
    if (signal.aborted) return;
    refresh(stale);
    const now = JSON.stringify([state, quality, alarms]);
    if (now !== seen) refresh(place, status(state, name), qualityCard(quality), alarmsCard(alarms.items), options(state.options, name));
    seen = now;
  };
  await update(); // an error of the first update is shown instead of the tab
  repeat(5, () => update().catch((error) => {
    if (!signal.aborted) refresh(stale, h("div", { class: "banner bad", role: "alert" }, `Out of date. ${sentence(error.message)} Retrying.`));
  }), signal);
}

function status({ options, status: at }, name) {
  const live = link("Follow live", `#/live/${encodeURIComponent(name)}`, "primary");
  if (!at.events) {
    const hint = options.enabled
      ? "Nothing learnt online yet. Send measured torque by a stream or in observation batches. "
      : "Learning is paused. ";
    return empty([hint, h("code", {}, `lipserve stream ${name} --simulate panda --learn`), " streams a simulated Panda."], live);
  }
  const behind = at.lag_events ? badge(`${counted(at.lag_events, "event")} behind`, "busy") : badge("up to date", "good");
  return card(
    "State",
    at.held ? h("div", { class: "banner bad", role: "note" }, h("strong", {}, "Learning is paused. "), `The robot may have changed${at.held.at ? ` ${ago(at.held.at)}` : ""}. Decide on the live page whether to adapt the model.`) : null,
    at.failure ? h("div", { class: "banner bad", role: "note" }, `Learning failed: ${at.failure}`) : null,
    facts([
      ["Learning version", String(at.version)],
      ["Serving revision", [`${count(at.published)} `, behind]],
      ["Observation batches logged", count(at.events)],
      ["Rows outside the training data", percent(at.novel_share)],
      ...(at.linearisation_error ? [["Linearisation error of the arm", `${percent(Math.max(...at.linearisation_error))} of the stated standard deviation`]] : []),
      ["Streams", at.streams.length ? at.streams.map((each) => each.stream_id).join(", ") : "none"],
    ]),
    h("p", {}, live),
  );
}

function qualityCard({ joint_names: names, windows, level }) {
  const withRows = windows.filter((each) => each.rows);
  if (!withRows.length) return null;
  const [latest] = withRows;
  const short = shortNames(names);
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    { label: "nMSE", numeric: true, cell: (joint) => scientific(latest.nmse[joint]) },
    { label: "RMSE, N·m", numeric: true, cell: (joint) => number(latest.rmse[joint]) },
    { label: `${percent(level, 0)} coverage`, numeric: true, cell: (joint) => percent(latest.coverage[joint]) },
  ];
  const kept = Object.entries(latest.rejected).filter(([, rows]) => rows).map(([code, rows]) => `${code} ${count(rows)}`);
  return card(
    "Recent quality",
    table(columns, names.map((_name, joint) => joint), { caption: `The last ${count(latest.seconds)} s, ${counted(latest.rows, "row")}, predicted before they were learnt` }),
    h("p", { class: "hint" }, `${count(latest.accepted)} of these rows were learnt${kept.length ? `; rejected: ${kept.join(", ")}` : ""}.`),
  );
}

function alarmsCard(alarms) {
  if (!alarms.length) return null;
  const columns = [
    { label: "Time", cell: (each) => when(each.at) },
    { label: "Kind", cell: (each) => badge(each.kind, each.kind === "change" ? "bad" : "plain") },
    { label: "Message", cell: (each) => each.message },
  ];
  return card("Recent alarms", table(columns, alarms));
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

function options(settings, name) {
  const pairs = Object.entries(SETTINGS).map(([key, [label, text]]) => [label, text(settings[key])]);
  return card("Settings", facts(pairs), h("p", { class: "hint" }, "Change the first three on the live page, and all of them with ", h("code", {}, `lipserve learning set ${name}`), "."));
}
