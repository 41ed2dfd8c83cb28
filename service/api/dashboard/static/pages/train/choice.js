// Selection of the recordings to train on; all must have the same joints and torque convention.

import { h } from "../../dom.js";
import { ago, count, counted, seconds, when } from "../../format.js";
import { listing } from "../../tables.js";
import { empty, link } from "../../ui.js";

/** Create checkboxes of data sets. onchange(chosen data sets) is called after every change. Returns {element, chosen(), changed()}. */
export function datasetChoice(datasets, preselected, onchange) {
  if (!datasets.length) {
    const none = empty("No recordings yet.", link("Upload a recording", "#/data", "primary"));
    return { element: none, chosen: () => [] };
  }
  const known = new Set(preselected);
  const boxes = new Map(
    datasets.map((each) => [
      each,
      h("input", { type: "checkbox", name: "datasets", value: each.id, checked: known.has(each.id), "aria-label": `Train on ${each.name}`, onchange: () => changed() }),
    ]),
  );
  const note = h("p", { class: "hint", role: "status" });
  const chosen = () => datasets.filter((each) => boxes.get(each).checked);
  const changed = () => {
    const picked = chosen();
    let incompatible = 0;
    for (const [each, box] of boxes) {
      const fits = !picked.length || isCompatible(each, picked[0]);
      box.disabled = !fits && !box.checked;
      incompatible += fits ? 0 : 1;
    }
    const rows = picked.reduce((sum, each) => sum + each.report.rows, 0);
    const others = incompatible ? ` ${counted(incompatible, "recording")} cannot be added: different joints or torque convention.` : "";
    note.textContent = picked.length ? `${picked.length} selected, ${counted(rows, "sample")}.${others}` : "No recording selected.";
    onchange(picked);
  };
  const list = listing(
    [
      { label: "Use", cell: (row) => boxes.get(row) },
      { label: "Recording", value: (row) => row.name, cell: (row) => link(row.name, `#/data/${row.id}`) },
      { label: "Robot", value: (row) => row.report.robot, cell: (row) => row.report.robot ?? "–" },
      { label: "Samples", numeric: true, value: (row) => row.report.rows, first: "descending", cell: (row) => count(row.report.rows) },
      { label: "Length", numeric: true, value: (row) => row.report.timing.duration_s, first: "descending", cell: (row) => seconds(row.report.timing.duration_s) },
      { label: "Episodes", numeric: true, value: (row) => row.report.episodes, cell: (row) => count(row.report.episodes) },
      { label: "Joints", numeric: true, value: (row) => row.joint_names.length, cell: (row) => row.joint_names.length },
      { label: "Uploaded", value: (row) => row.created_at, first: "descending", cell: (row) => h("time", { datetime: row.created_at, title: when(row.created_at) }, ago(row.created_at)) },
    ],
    {
      caption: "Recordings, newest first",
      what: ["recording", "recordings"],
      key: (row) => row.id,
      words: (row) => [row.name, row.report.robot, row.id, ...row.joint_names].join(" "),
      minRows: 4,
    },
  );
  list.show(datasets);
  const element = h("div", { class: "recordings" }, list.element, note);
  return { element, chosen, changed };
}

function isCompatible(one, other) {
  return one.torque_convention === other.torque_convention && one.joint_names.join("\n") === other.joint_names.join("\n");
}
