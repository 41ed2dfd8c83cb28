// Selection of the recordings to train on; all must have the same joints and torque convention.

import { Link, Listing } from "../../components.js";
import { ago, count, counted, seconds, when } from "../../format.js";
import { html } from "../../preact.js";
import { VerdictBadge } from "../../verdicts.js";

/** Checkboxes of data sets. first: ids at the top; chosen: ids; onchange(ids). A recording that cannot be added tells why. */
export function Recordings({ datasets, first, chosen, onchange }) {
  const rows = [...datasets.filter((each) => first.includes(each.id)), ...datasets.filter((each) => !first.includes(each.id))];
  const picked = datasets.filter((each) => chosen.includes(each.id));
  const toggle = ({ id }) => onchange(chosen.includes(id) ? chosen.filter((each) => each !== id) : [...chosen, id]);
  const why = (row) => (picked.length && !chosen.includes(row.id) ? difference(row, picked[0]) : "");
  const box = (row) => html`<input type="checkbox" name="datasets" value=${row.id} checked=${chosen.includes(row.id)} disabled=${Boolean(why(row))} onChange=${() => toggle(row)} aria-label=${`Train on ${row.name}`} />`;
  const name = (row) => html`<${Link} to=${`#/data/${row.id}`}>${row.name}<//>${why(row) && html`<span class="hint why-not">cannot be added: ${why(row)}</span>`}`;
  const columns = [
    { label: "Use", cell: box },
    { label: "Recording", value: (row) => row.name, cell: name },
    { label: "Best verdict", value: (row) => row.learnability.label, cell: (row) => html`<${VerdictBadge} verdict=${row.learnability} />` },
    { label: "Robot", value: (row) => row.report.robot, cell: (row) => row.report.robot ?? "–" },
    { label: "Samples", numeric: true, value: (row) => row.report.rows, first: "descending", cell: (row) => count(row.report.rows) },
    { label: "Length", numeric: true, value: (row) => row.report.timing.duration_s, first: "descending", cell: (row) => seconds(row.report.timing.duration_s) },
    { label: "Episodes", numeric: true, value: (row) => row.report.episodes, cell: (row) => count(row.report.episodes) },
    { label: "Joints", numeric: true, value: (row) => row.joint_names.length, cell: (row) => row.joint_names.length },
    { label: "Uploaded", value: (row) => row.created_at, first: "descending", cell: (row) => html`<time datetime=${row.created_at} title=${when(row.created_at)}>${ago(row.created_at)}</time>` },
  ];
  const words = (row) => [row.name, row.report.robot, row.id, ...row.joint_names].join(" ");
  const samples = picked.reduce((sum, each) => sum + each.report.rows, 0);
  return html`<div class="recordings">
    <${Listing} columns=${columns} rows=${rows} caption="Recordings" what=${["recording", "recordings"]} identity=${(row) => row.id} words=${words} minRows=${4} />
    <p class="hint" role="status">${picked.length ? `${picked.length} selected, ${counted(samples, "sample")}.` : "No recording selected."}</p>
  </div>`;
}

/** Say why a recording cannot be trained on together with another; an empty text if it can. */
function difference(one, other) {
  if (one.joint_names.length !== other.joint_names.length) return `${counted(one.joint_names.length, "joint")}, not ${other.joint_names.length}`;
  if (one.joint_names.join("\n") !== other.joint_names.join("\n")) return "other joint names";
  return one.torque_convention === other.torque_convention ? "" : "other torque convention";
}
