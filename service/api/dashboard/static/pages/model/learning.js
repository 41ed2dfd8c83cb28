// How a model learns while it serves: where it stands, how well it predicted lately, what it reports.

import { get } from "../../api.js";
import { h, refresh, replace } from "../../dom.js";
import { ago, count, counted, number, percent, scientific, seconds, shortNames, when } from "../../format.js";
import { badge, card, empty, every, facts, link, loading, table } from "../../ui.js";

/** The tab of learning; it looks again every five seconds. */
export async function learning(view, { where, name }, { signal }) {
  const stale = h("div", {}), place = h("div", {}, loading());
  replace(view, stale, place);
  let seen = "";
  const look = async () => {
    const [said, quality, alarms] = await Promise.all([
      get(`${where}/learning`, {}, signal),
      get(`${where}/quality`, {}, signal),
      get(`${where}/alarms`, { limit: 5 }, signal),
    ]);
    if (signal.aborted) return;
    refresh(stale);
    const now = JSON.stringify([said, quality, alarms]);
    if (now !== seen) refresh(place, status(said, name), qualityCard(quality), alarmsCard(alarms.items), options(said.options, name));
    seen = now;
  };
  await look(); // what goes wrong the first time is shown in the page's place
  every(5, () => look().catch((error) => {
    if (!signal.aborted) refresh(stale, h("div", { class: "banner bad", role: "alert" }, `What is shown here is out of date: ${error.message}. Trying again.`));
  }), signal);
}

function status({ options, status: at }, name) {
  const live = link("Follow it live", `#/live/${encodeURIComponent(name)}`, "primary");
  if (!at.events) {
    const said = options.enabled
      ? "It has learnt nothing while serving so far. Send measured torque, along a stream or in batches. "
      : "Learning is paused. ";
    return empty([said, h("code", {}, `lipserve stream ${name} --simulate panda --learn`), " shows how with a simulated Panda."], live);
  }
  const behind = at.lag_events ? badge(`${counted(at.lag_events, "event")} behind`, "busy") : badge("up to date", "good");
  return card(
    "State",
    at.held ? h("div", { class: "banner bad", role: "note" }, h("strong", {}, "Learning is held. "), `The robot seems to have changed${at.held.at ? ` ${ago(at.held.at)}` : ""}: decide on the live page whether to adapt or to go on.`) : null,
    at.failure ? h("div", { class: "banner bad", role: "note" }, `It cannot learn now: ${at.failure}`) : null,
    facts([
      ["Version that learns", String(at.version)],
      ["Answers contain", [`revision ${count(at.published)} `, behind]],
      ["Batches logged", count(at.events)],
      ["Rows beyond what it was trained on", percent(at.novel_share)],
      ...(at.linearisation_error ? [["Linearisation error of the arm", `${percent(Math.max(...at.linearisation_error))} of the stated uncertainty`]] : []),
      ["Sources", at.streams.length ? at.streams.map((each) => each.stream_id).join(", ") : "none"],
    ]),
    h("p", {}, live),
  );
}

function qualityCard({ joint_names: names, windows, level }) {
  const told = windows.filter((each) => each.rows);
  if (!told.length) return null;
  const [latest] = told;
  const short = shortNames(names);
  const columns = [
    { label: "Joint", cell: (joint) => short[joint] },
    { label: "nMSE", numeric: true, cell: (joint) => scientific(latest.nmse[joint]) },
    { label: "RMSE, N·m", numeric: true, cell: (joint) => number(latest.rmse[joint]) },
    { label: `in ${percent(level, 0)}`, numeric: true, cell: (joint) => percent(latest.coverage[joint]) },
  ];
  const kept = Object.entries(latest.rejected).filter(([, rows]) => rows).map(([code, rows]) => `${code} ${count(rows)}`);
  return card(
    "Recent quality",
    table(columns, names.map((_name, joint) => joint), { caption: `The last ${count(latest.seconds)} s, ${counted(latest.rows, "row")}, each predicted before it was learnt` }),
    h("p", { class: "hint" }, `${count(latest.accepted)} of these rows were learnt${kept.length ? `; kept out: ${kept.join(", ")}` : ""}.`),
  );
}

function alarmsCard(alarms) {
  if (!alarms.length) return null;
  const columns = [
    { label: "When", cell: (each) => when(each.at) },
    { label: "Kind", cell: (each) => badge(each.kind, each.kind === "change" ? "bad" : "plain") },
    { label: "What", cell: (each) => each.message },
  ];
  return card("Latest alarms", table(columns, alarms));
}

const yes = (value) => (value ? "yes" : "no");
const after = (value) => (value === null ? "never" : `after ${seconds(value)}`);
const SETTINGS = {
  enabled: ["Learns from streams", yes],
  on_change: ["When the robot changes", (value) => ({ hold: "waits for your decision", adapt: "adapts to it", learn: "learns on as before" })[value] ?? value],
  forgetting_s: ["Forgets", after],
  friction_walk_s: ["Friction may drift", (value) => (value === null ? "no" : `over ${seconds(value)}`)],
  torque_limits: ["Torque limits, N·m", (value) => value?.join(", ") ?? "none"],
  contact_threshold: ["A contact is beyond", (value) => `${number(value)} σ`],
  adaptive_intervals: ["Bands follow errors", yes],
  payloads: ["Weighs payloads", yes],
  auto_refresh: ["Trains again when needed", yes],
  auto_promote: ["Better versions answer", yes],
};

function options(said, name) {
  const pairs = Object.entries(SETTINGS).map(([key, [label, text]]) => [label, text(said[key])]);
  return card("Settings", facts(pairs), h("p", { class: "hint" }, "The live page has switches for the first three. All can be changed with ", h("code", {}, `lipserve learning set ${name}`), "."));
}
