// Tabs of a data set's report: figures of each joint.

import { jointVar } from "../../colours.js";
import { Badge, Card, Facts, Table } from "../../components.js";
import { count, number, percent, seconds, shortNames } from "../../format.js";
import { html } from "../../preact.js";
import { Prose } from "../../prose.js";
import { Sentences } from "./findings.js";

/** Rate, jitter, gaps, and the lag of the torque. */
export function TimingTab({ report, joints }) {
  return html`<div class="grid wide"><${Timing} report=${report} /><${Lag} rows=${report.lag} joints=${joints} /></div>`;
}

/** Motion of the joints, compared with their limits. */
export function ExcitationTab({ report, joints }) {
  return html`<${Motion} found=${report.excitation} joints=${joints} /><${Limits} rows=${report.limits} joints=${joints} /><${Ranges} report=${report} joints=${joints} />`;
}

/** Identifiability of friction, torque compared with the robot's URDF, noise and saturation. */
export function FrictionTab({ report, joints }) {
  return html`<${Friction} found=${report.excitation} joints=${joints} />
    ${report.against_robot && html`<${AgainstRobot} found=${report.against_robot} joints=${joints} />`}
    <${Noise} report=${report} joints=${joints} />
    <${Saturation} rows=${report.saturation} joints=${joints} />`;
}

/** How the columns were read, and every preparation step. */
export function PreparationTab({ report }) {
  const figures = { source: report.source, recipe: report.recipe, steps: report.steps };
  return html`<${Card} title="Reading">
    ${report.reading.length > 0 && html`<${Sentences} texts=${report.reading} />`}
    <h3>Preparation</h3>
    ${report.preparation.length ? html`<${Sentences} texts=${report.preparation} />` : html`<p>No changes.</p>`}
    <details><summary>All settings as JSON</summary><pre tabindex="0"><code>${JSON.stringify(figures, null, 2)}</code></pre></details>
  <//>`;
}

/** A column of joint names in their colours. */
function jointColumn(joints) {
  const names = shortNames(joints);
  const cell = ({ joint }) => {
    const index = joints.indexOf(joint);
    if (joint === null) return "all joints";
    return index < 0 ? joint : html`<span class="joint" style=${`--own: ${jointVar(index)}`}>${names[index]}</span>`;
  };
  return { label: "Joint", cell };
}

/** A share as text on a bar. */
function bar(share, text = percent(share, 0)) {
  return share === null ? "–" : html`<span class="share" style=${`--of: ${Math.max(0, Math.min(share, 1))}`}>${text}</span>`;
}

/** A share that should be zero. */
function fault(share) {
  return share > 0 ? html`<${Badge} state=${percent(share, 2)} kind="warn" />` : percent(share, 2);
}

/** Labels and kinds of badges by the verdict of the report. */
const IDENTIFIABILITY = { well: ["identifiable", "good"], poorly: ["weak", "warn"], "not determined": ["unidentifiable", "bad"] };

function Motion({ found, joints }) {
  const { whole } = found;
  const columns = [
    jointColumn(joints),
    { label: "Range covered", cell: (row) => bar(row.visited) },
    { label: "Span, rad or m", numeric: true, cell: (row) => number(row.span) },
    { label: "Reversals", numeric: true, cell: (row) => count(row.reversals) },
    { label: "At rest", numeric: true, cell: (row) => percent(row.still, 0) },
    { label: "Forward / backward", numeric: true, cell: (row) => `${percent(row.forwards, 0)} / ${percent(row.backwards, 0)}` },
    { label: "Most collinear term", numeric: true, cell: (row) => `${row.collinear_term} ${percent(row.collinear, 0)}` },
  ];
  return html`<${Card} title="Joint motion">
    <${Table} columns=${columns} rows=${found.joints} />
    ${whole
      ? html`<p>${whole.rank} of ${whole.parameters} rigid-body base parameters are sufficiently excited. The weakest is excited at ${percent(whole.weakest)} of the level of random motion; it belongs to the body that ${whole.weakest_body} moves.</p>`
      : html`<p class="hint">To check the excitation of the rigid bodies, upload the recording with a robot that has a URDF.</p>`}
    ${found.motion_dimensions != null && html`<p>The motion has ${number(found.motion_dimensions, 2)} independent dimensions of ${found.joints.length}. All joints are at rest in ${percent(found.standstill, 0)} of the samples.</p>`}
    <details><summary>Description</summary><p><${Prose} text=${found.text} /></p></details>
  <//>`;
}

function Friction({ found, joints }) {
  const weight = (name) => ({ [name]: { verdict, std, value, implausible } }) => {
    const [label, kind] = implausible ? ["implausible", "bad"] : IDENTIFIABILITY[verdict];
    return html`<${Badge} state=${label} kind=${kind} />${value == null ? "" : ` ${number(value, 2)}`}${std === null ? "" : ` ±\u00a0${number(std, 2)}`}`;
  };
  const beside = found.friction_beside === "rigid bodies" ? "the torque of the robot’s rigid bodies" : "any torque that is a smooth function of the motion";
  const columns = [
    jointColumn(joints),
    { label: "Viscous friction", cell: weight("viscous") },
    { label: "Coulomb friction", cell: weight("coulomb") },
    { label: "Constant torque", cell: weight("offset") },
  ];
  return html`<${Card} title="Identifiability of friction" term="identifiability"><${Table} columns=${columns} rows=${found.joints} caption=${`Estimated together with ${beside}; ±: one standard deviation`} /><//>`;
}

function AgainstRobot({ found, joints }) {
  const times = (part) => (row) => (row[part] === null ? "–" : `${number(row[part], 3)} ± ${number(row[`${part}_std`], 2)}`);
  const columns = [
    jointColumn(joints),
    { label: "Gravity, ratio", numeric: true, cell: times("gravity") },
    { label: "Inertia, ratio", numeric: true, cell: times("inertia") },
    { label: "Explained with friction", cell: (row) => bar(row.explained) },
  ];
  const caption = "1: equal to the URDF. Rotor inertia, which the URDF omits, increases inertia; a payload increases both. Explained: share of the variance";
  return html`<${Card} title=${`Torque compared with the URDF of ${found.robot}`}><${Table} columns=${columns} rows=${found.joints} caption=${caption} /><//>`;
}

function Limits({ rows, joints }) {
  if (!rows.some((row) => [row.range_used, row.speed_used, row.torque_used].some((share) => share !== null))) return null;
  const used = (share, beyond) => (row) => (row[beyond] > 0 ? html`<${Badge} state=${`${percent(row[share], 0)}, limit exceeded in ${percent(row[beyond], 2)}`} kind="bad" />` : bar(row[share]));
  const columns = [
    jointColumn(joints),
    { label: "Range used", cell: used("range_used", "beyond_range") },
    { label: "Speed used", cell: used("speed_used", "beyond_speed") },
    { label: "Torque used", cell: used("torque_used", "beyond_torque") },
  ];
  return html`<${Card} title="Use of the robot's limits"><${Table} columns=${columns} rows=${rows} caption="A model extrapolates beyond the used range; 100 % is the limit" /><//>`;
}

function Ranges({ report, joints }) {
  const between = (name) => (row) => `${number(report.ranges[name]?.min[row.index])} … ${number(report.ranges[name]?.max[row.index])}`;
  const columns = [
    jointColumn(joints),
    { label: "q, rad or m", numeric: true, cell: between("q") },
    { label: "dq, per s", numeric: true, cell: between("dq") },
    { label: "ddq, per s²", numeric: true, cell: between("ddq") },
    { label: "tau, N·m or N", numeric: true, cell: between("tau") },
  ];
  return html`<${Card} title="Ranges"><${Table} columns=${columns} rows=${joints.map((joint, index) => ({ joint, index }))} caption="Minimum … maximum" /><//>`;
}

function Noise({ report, joints }) {
  const columns = [
    jointColumn(joints),
    { label: "Torque, N·m", numeric: true, cell: (row) => (row.smoothed ? "smoothed" : number(row.torque, 2)) },
    { label: "of its std", numeric: true, cell: (row) => percent(row.torque_share) },
    { label: "Velocity, per s", numeric: true, cell: (row) => number(row.velocity, 2) },
    { label: "of its std", numeric: true, cell: (row) => percent(row.velocity_share) },
  ];
  return html`<${Card} title="Noise"><${Table} columns=${columns} rows=${report.noise} caption="Standard deviation of the white noise as recorded" /><//>`;
}

function Lag({ rows, joints }) {
  const known = rows.filter((row) => row.seconds !== null);
  const why = Object.groupBy(rows.filter((row) => row.seconds === null), (row) => row.reason);
  const columns = [
    jointColumn(joints),
    { label: "Lag, ms", numeric: true, cell: (row) => `${number(1e3 * row.seconds, 2)} ± ${number(1e3 * row.std_s, 2)}` },
    { label: "Error from the lag, share of variance", numeric: true, cell: (row) => percent(row.cost, 2) },
  ];
  return html`<${Card} title="Lag of torque behind motion">
    ${known.length > 0 && html`<${Table} columns=${columns} rows=${known} caption="Negative: the torque precedes the motion; ±: one standard deviation" />`}
    ${Object.entries(why).map(([reason, who]) => html`<p key=${reason}>Lag unknown for ${who.map((row) => row.joint ?? "all joints").join(", ")}: ${reason}</p>`)}
  <//>`;
}

function Timing({ report }) {
  const found = report.timing;
  const pairs = [
    ["Rate as uploaded", found.rate_hz === null ? "unknown" : `${number(found.rate_hz, 4)} Hz`],
    ["Jitter, 50th / 99th percentile", `${percent(found.jitter_p50)} / ${percent(found.jitter_p99)}`],
    ["Max jitter", percent(found.jitter_max)],
    ["Gaps", count(report.gaps)],
    ["Rows dropped, repeated time", count(found.repeated_stamps)],
    ["Rows dropped, missing value", count(found.missing_rows)],
  ];
  const columns = [
    { label: "Starts at, s", numeric: true, cell: (row) => number(row.t, 6) },
    { label: "Duration", numeric: true, cell: (row) => seconds(row.seconds) },
  ];
  return html`<${Card} title="Timing"><${Facts} pairs=${pairs} />${found.gaps.length > 0 && html`<${Table} columns=${columns} rows=${found.gaps} caption="Longest gaps (max 20)" />`}<//>`;
}

function Saturation({ rows, joints }) {
  const columns = [
    jointColumn(joints),
    { label: "At min or max torque", numeric: true, cell: (row) => percent(row.at_largest, 2) },
    { label: "Constant while moving", numeric: true, cell: (row) => fault(row.flat) },
    { label: "At torque limit", numeric: true, cell: (row) => fault(row.at_limit) },
  ];
  return html`<${Card} title="Possible saturation"><${Table} columns=${columns} rows=${rows} caption="Share of samples with a torque that may be clipped" /><//>`;
}
