// Status of learning, quality and answers, updated once per second.

import { h } from "../../dom.js";
import { count, counted, number, percent, scientific, seconds, sentence, shortNames, torqueUnit } from "../../format.js";
import { badge, facts, table } from "../../ui.js";
import { codeLabel } from "./codes.js";

/** Return the state of learning and the counts of rows by code. */
export function learningFacts(status) {
  const [latest] = status.windows;
  const recentCounts = { learnt: latest.accepted, ...latest.rejected };
  const codes = Object.keys(status.counts).filter((code) => !["batches", "duplicates"].includes(code) && (status.counts[code] || recentCounts[code]));
  const state = status.held ? badge("paused by a change", "warn") : status.learns ? badge("enabled", "good") : badge("paused", "warn");
  return [
    facts([
      ["Serving", `version ${status.version}, revision ${count(status.revision)}`],
      ["Pending", status.lag_rows ? `${counted(status.lag_rows, "row")}, ${seconds(status.lag_s)}` : "none"],
      ["Learning", state],
      ["Outside the training data", status.novel_share === null ? "unknown" : `${percent(status.novel_share, 0)} of rows`],
    ]),
    status.failure ? h("div", { class: "banner bad" }, `Learning failed. ${sentence(status.failure)} Retrying.`) : null,
    codes.length
      ? table(
          [
            { label: "Rows", cell: codeLabel },
            { label: `last ${span(latest.seconds)}`, numeric: true, cell: (code) => count(recentCounts[code] ?? 0) },
            { label: "since service start", numeric: true, cell: (code) => count(status.counts[code]) },
          ],
          codes,
          { caption: "Rows by result" },
        )
      : h("p", { class: "muted" }, "No rows since the service started."),
  ];
}

/** Return a card with the quality of the predictions of the last minute. */
export function qualityCard({ windows: [latest], joint_names: names, joint_types: types, level, scale }) {
  const short = shortNames(names);
  if (!latest.rows) return panel("Quality", h("p", { class: "muted" }, `No measured torque in the last ${span(latest.seconds)}.`));
  return panel(
    "Quality",
    table(
      [
        { label: "Joint", cell: (joint) => short[joint] },
        { label: "nMSE", numeric: true, cell: (joint) => scientific(latest.nmse[joint]) },
        { label: "RMSE", numeric: true, cell: (joint) => `${number(latest.rmse[joint], 2)}\u00a0${torqueUnit(types[joint])}` },
        { label: `${percent(level, 0)} coverage`, numeric: true, cell: (joint) => percent(latest.coverage[joint]) },
        { label: "served coverage", numeric: true, cell: (joint) => percent(latest.coverage_answered[joint]) },
        { label: "factor", numeric: true, cell: (joint) => `×\u00a0${number(scale[joint], 2)}` },
      ],
      names.map((_name, joint) => joint),
      { caption: `${count(latest.rows)} rows of the last ${span(latest.seconds)}, predicted before they were learnt` },
    ),
    h("p", { class: "hint" }, "nMSE: mean squared error / variance of the torque; 0 is best. The first coverage is that of the model’s own intervals, the second that of the served ones. Served intervals are scaled by the factor. It adapts to recent errors, also at rest and during contacts, so that coverage reaches ", percent(level, 0), "."),
  );
}

/** Return a line with the latency of the answers since the last status; null if there were none. */
export function latencyLine({ answers }) {
  if (!answers?.count) return null;
  const within = (bound) => (bound === null ? "> 30 s" : `≤ ${seconds(bound)}`);
  return h(
    "section",
    { class: "vitals", "aria-label": "Stream answers", title: "All streams of this model in the last second; time in the service, without the network" },
    facts([
      ["Answers per second", count(answers.count / answers.seconds)],
      ["Median latency", within(answers.p50_at_most_s)],
      ["99th percentile", within(answers.p99_at_most_s)],
      ...(answers.late ? [["Late", badge(`${count(answers.late)} late`, "warn")]] : []),
      ...(answers.refused ? [["Rejected", badge(`${count(answers.refused)} rejected`, "bad")]] : []),
    ]),
  );
}

function panel(name, ...children) {
  return h("section", { class: "card", "aria-label": name }, h("h2", {}, name), children);
}

function span(length) {
  return length === 60 ? "minute" : seconds(length);
}
