// Where learning, quality and answers stand, once a second.

import { h } from "../../dom.js";
import { count, counted, number, percent, scientific, seconds, shortNames, torqueUnit } from "../../format.js";
import { badge, facts, table } from "../../ui.js";
import { words } from "./codes.js";

/** Version, how far answers lag behind, and what became of rows. */
export function learningFacts(status) {
  const [latest] = status.windows;
  const lately = { learnt: latest.accepted, ...latest.rejected };
  const codes = Object.keys(status.counts).filter((code) => !["batches", "duplicates"].includes(code) && (status.counts[code] || lately[code]));
  const state = status.held ? badge("held", "warn") : status.learns ? badge("learns", "good") : badge("paused", "warn");
  return [
    facts([
      ["Answers contain", `version ${status.version}, revision ${count(status.revision)}`],
      ["Not learnt yet", status.lag_rows ? `${counted(status.lag_rows, "row")}, ${seconds(status.lag_s)}` : "nothing"],
      ["Learning", state],
      ["Beyond what it was trained on", status.novel_share === null ? "not known yet" : `${percent(status.novel_share, 0)} of rows`],
    ]),
    status.failure ? h("div", { class: "banner bad" }, `It cannot learn: ${status.failure}. Trying again.`) : null,
    codes.length
      ? table(
          [
            { label: "Rows", cell: words },
            { label: `last ${span(latest.seconds)}`, numeric: true, cell: (code) => count(lately[code] ?? 0) },
            { label: "since service start", numeric: true, cell: (code) => count(status.counts[code]) },
          ],
          codes,
          { caption: "What became of rows" },
        )
      : h("p", { class: "muted" }, "No row has come since the service started."),
  ];
}

/** How well rows of the last minute were predicted before they were learnt. */
export function qualityCard({ windows: [latest], joint_names: names, joint_types: types, level, scale }) {
  const short = shortNames(names);
  if (!latest.rows) return panel("Quality", h("p", { class: "muted" }, `No measured torque came in the last ${span(latest.seconds)}.`));
  return panel(
    "Quality",
    table(
      [
        { label: "Joint", cell: (joint) => short[joint] },
        { label: "nMSE", numeric: true, cell: (joint) => scientific(latest.nmse[joint]) },
        { label: "RMSE", numeric: true, cell: (joint) => `${number(latest.rmse[joint], 2)}\u00a0${torqueUnit(types[joint])}` },
        { label: `in ${percent(level, 0)} band`, numeric: true, cell: (joint) => percent(latest.coverage[joint]) },
        { label: "as answered", numeric: true, cell: (joint) => percent(latest.coverage_answered[joint]) },
        { label: "widened", numeric: true, cell: (joint) => `×\u00a0${number(scale[joint], 2)}` },
      ],
      names.map((_name, joint) => joint),
      { caption: `${count(latest.rows)} rows of the last ${span(latest.seconds)}, each predicted before it was learnt` },
    ),
    h("p", { class: "hint" }, "nMSE: mean squared error / variance of the torque; 0 is best. The band is the model's own belief; as answered, it is widened at once by what streams measure, contacts and rest included, so that ", percent(level, 0), " lie inside."),
  );
}

/** How fast all streams were answered since the last status, inside the service: a line; nothing where none was. */
export function vitals({ answers }) {
  if (!answers?.count) return null;
  const within = (bound) => (bound === null ? "more than 30 s" : `at most ${seconds(bound)}`);
  return h(
    "section",
    { class: "vitals", "aria-label": "Answers of streams", title: "All streams of this model in the last second: time inside the service, without the network" },
    facts([
      ["Answers a second", count(answers.count / answers.seconds)],
      ["Half of them", within(answers.p50_at_most_s)],
      ["99 % of them", within(answers.p99_at_most_s)],
      ...(answers.late ? [["Late", badge(`${count(answers.late)} late`, "warn")]] : []),
      ...(answers.refused ? [["Refused", badge(`${count(answers.refused)} refused`, "bad")]] : []),
    ]),
  );
}

function panel(name, ...children) {
  return h("section", { class: "card", "aria-label": name }, h("h2", {}, name), children);
}

function span(length) {
  return length === 60 ? "minute" : seconds(length);
}
