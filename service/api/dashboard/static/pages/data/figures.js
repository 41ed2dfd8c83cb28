// What was found in a data set, tab by tab: figures joint by joint.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, number, percent, seconds, shortNames } from "../../format.js";
import { badge, card, facts, table } from "../../ui.js";
import { prose, sentences } from "./prose.js";

/** Rate, jitter and gaps, and how far the torque lags behind the motion. */
export function timingTab({ report, joint_names: joints }) {
  return h("div", { class: "grid wide" }, timing(report), lag(report.lag, joints));
}

/** How far joints were moved, against what they can do. */
export function excitationTab({ report, joint_names: joints }) {
  return [motion(report.excitation, joints), limits(report.limits, joints), ranges(report, joints)];
}

/** How well friction can be told, the torque against that of the robot's URDF, and how far it can be trusted. */
export function frictionTab({ report, joint_names: joints }) {
  return [
    friction(report.excitation, joints),
    h("div", { class: "grid wide" }, againstRobot(report.against_robot, joints), noise(report, joints), saturation(report.saturation, joints)),
  ];
}

/** What the columns were taken as, and every step that changed the data. */
export function preparationTab({ report }) {
  return preparation(report);
}

/** A column with the joints' names in their colours. */
function short(joints) {
  const names = shortNames(joints);
  const cell = ({ joint }) => {
    const index = joints.indexOf(joint);
    return index < 0 ? joint : h("span", { class: "joint", style: `--own: ${jointVar(index)}` }, names[index]);
  };
  return { label: "Joint", cell };
}

/** A share as text on a bar. */
function bar(share, text = percent(share, 0)) {
  return share === null ? "–" : h("span", { class: "share", style: `--of: ${Math.max(0, Math.min(share, 1))}` }, text);
}

function motion(found, joints) {
  const whole = found.whole;
  return card(
    "How the joints were moved",
    table(
      [
        short(joints),
        { label: "Range visited", cell: (row) => bar(row.visited) },
        { label: "Span, rad or m", numeric: true, cell: (row) => number(row.span) },
        { label: "Reversals", numeric: true, cell: (row) => count(row.reversals) },
        { label: "Still", numeric: true, cell: (row) => percent(row.still, 0) },
        { label: "Forwards / backwards", numeric: true, cell: (row) => `${percent(row.forwards, 0)} / ${percent(row.backwards, 0)}` },
        { label: "Most collinear", numeric: true, cell: (row) => `${row.collinear_term} ${percent(row.collinear, 0)}` },
      ],
      found.joints,
    ),
    whole
      ? h(
          "p",
          {},
          `Rigid bodies: ${whole.rank} of ${whole.parameters} base parameters are excited enough. `,
          `Weakest: the body that ${whole.weakest_body} moves, with ${percent(whole.weakest)} of what random motion gives.`,
        )
      : h("p", { class: "hint" }, "Rigid bodies are judged only if the upload names a robot with a URDF."),
    found.motion_dimensions == null
      ? null
      : h("p", {}, `The joints move like ${number(found.motion_dimensions, 2)} independent ones of ${found.joints.length}, and all stand still in ${percent(found.standstill, 0)} of the samples.`),
    h("details", {}, h("summary", {}, "The same in words"), h("p", {}, prose(found.text))),
  );
}

function friction(found, joints) {
  const weight = (name) => (row) => {
    const { verdict, std, value, implausible } = row[name];
    const figure = value == null ? "" : ` ${number(value, 2)}`;
    return [implausible ? badge("implausible", "bad") : badge(verdict), figure, std === null ? "" : ` ±\u00a0${number(std, 2)}`];
  };
  const beside = found.friction_beside === "rigid bodies" ? "the robot’s rigid bodies" : "any smooth function of the motion";
  return card(
    "Can friction be told?",
    table(
      [
        short(joints),
        { label: "Viscous friction", cell: weight("viscous") },
        { label: "Coulomb friction", cell: weight("coulomb") },
        { label: "Constant torque", cell: weight("offset") },
      ],
      found.joints,
      { caption: `Told apart from ${beside}; ±: one standard deviation` },
    ),
  );
}

function againstRobot(found, joints) {
  if (!found) return null;
  const times = (part) => (row) => (row[part] === null ? "–" : `${number(row[part], 3)} ± ${number(row[`${part}_std`], 2)}`);
  return card(
    `Torque against that of ${found.robot}`,
    table(
      [
        short(joints),
        { label: "Gravity, times", numeric: true, cell: times("gravity") },
        { label: "Inertia, times", numeric: true, cell: times("inertia") },
        { label: "Explained with friction", cell: (row) => bar(row.explained) },
      ],
      found.joints,
      { caption: "1: as the robot’s URDF has it. Rotors, which it lacks, make inertia larger, loads both" },
    ),
  );
}

function limits(rows, joints) {
  if (!rows.some((row) => [row.range_used, row.speed_used, row.torque_used].some((share) => share !== null))) return null;
  const used = (share, beyond) => (row) => {
    return row[beyond] > 0 ? badge(`${percent(row[share], 0)}, beyond in ${percent(row[beyond], 2)}`, "bad") : bar(row[share]);
  };
  return card(
    "Against the robot's limits",
    table(
      [
        short(joints),
        { label: "Range used", cell: used("range_used", "beyond_range") },
        { label: "Speed, of limit", cell: used("speed_used", "beyond_speed") },
        { label: "Torque, of limit", cell: used("torque_used", "beyond_torque") },
      ],
      rows,
      { caption: "Outside what is used here, a model has to extrapolate" },
    ),
  );
}

function ranges(report, joints) {
  const between = (name) => (row) => `${number(report.ranges[name]?.min[row.index])} … ${number(report.ranges[name]?.max[row.index])}`;
  return card(
    "Ranges",
    table(
      [
        short(joints),
        { label: "q, rad or m", numeric: true, cell: between("q") },
        { label: "dq, per s", numeric: true, cell: between("dq") },
        { label: "ddq, per s²", numeric: true, cell: between("ddq") },
        { label: "tau, N·m or N", numeric: true, cell: between("tau") },
      ],
      joints.map((joint, index) => ({ joint, index })),
      { caption: "Smallest and largest value" },
    ),
  );
}

function noise(report, joints) {
  return card(
    "Noise",
    table(
      [
        short(joints),
        { label: "Torque, N·m", numeric: true, cell: (row) => (row.smoothed ? "smoothed" : number(row.torque, 2)) },
        { label: "of its spread", numeric: true, cell: (row) => percent(row.torque_share) },
        { label: "Velocity, per s", numeric: true, cell: (row) => number(row.velocity, 2) },
        { label: "of its spread", numeric: true, cell: (row) => percent(row.velocity_share) },
      ],
      report.noise,
      { caption: "Standard deviation of white noise, as recorded" },
    ),
  );
}

function lag(rows, joints) {
  const known = rows.filter((row) => row.seconds !== null);
  const why = new Map();
  for (const row of rows.filter((each) => each.seconds === null)) why.set(row.reason, [...(why.get(row.reason) ?? []), row]);
  return card(
    "Lag of torque behind motion",
    known.length
      ? table(
          [
            { label: "Joint", cell: (row) => (row.joint === null ? "all together" : short(joints).cell(row)) },
            { label: "Lag, ms", numeric: true, cell: (row) => `${number(1e3 * row.seconds, 2)} ± ${number(1e3 * row.std_s, 2)}` },
            { label: "Costs, of variance", numeric: true, cell: (row) => percent(row.cost, 2) },
          ],
          known,
          { caption: "Negative: the torque comes first; ± one standard deviation" },
        )
      : null,
    [...why].map(([reason, who]) =>
      h("p", {}, `Cannot be told for ${who.map((row) => row.joint ?? "all joints together").join(", ")}: `, reason),
    ),
  );
}

function timing(report) {
  const found = report.timing;
  return card(
    "Timing",
    facts([
      ["Rate as uploaded", found.rate_hz === null ? "not known" : `${number(found.rate_hz, 4)} Hz`],
      ["Jitter, 50 / 99 % of steps", `${percent(found.jitter_p50)} / ${percent(found.jitter_p99)}`],
      ["Largest jitter", percent(found.jitter_max)],
      ["Gaps", count(report.gaps)],
      ["Repeated stamps left out", count(found.repeated_stamps)],
      ["Rows left out, value missing", count(found.missing_rows)],
    ]),
    found.gaps.length
      ? table(
          [
            { label: "After t, s", numeric: true, cell: (row) => number(row.t, 6) },
            { label: "Lasts", numeric: true, cell: (row) => seconds(row.seconds) },
          ],
          found.gaps,
          { caption: "The longest gaps, at most 20" },
        )
      : null,
  );
}

function saturation(rows, joints) {
  return card(
    "Signs of saturation",
    table(
      [
        short(joints),
        { label: "At its extremes", numeric: true, cell: (row) => percent(row.at_largest, 2) },
        { label: "Flat while moving", numeric: true, cell: (row) => (row.flat > 0 ? badge(percent(row.flat, 2), "warn") : percent(row.flat, 2)) },
        { label: "At the robot's limit", numeric: true, cell: (row) => (row.at_limit > 0 ? badge(percent(row.at_limit, 2), "warn") : percent(row.at_limit, 2)) },
      ],
      rows,
      { caption: "Share of samples whose torque may have been cut off" },
    ),
  );
}

function preparation(report) {
  const figures = { source: report.source, recipe: report.recipe, steps: report.steps };
  const steps = report.preparation.length ? sentences(report.preparation) : h("p", {}, "Nothing was changed.");
  return card(
    "How it was read and prepared",
    report.reading.length ? sentences(report.reading) : null,
    h("h3", {}, "Preparation"),
    steps,
    h("details", {}, h("summary", {}, "Everything, in figures"), h("pre", {}, h("code", {}, JSON.stringify(figures, null, 2)))),
  );
}
