// Tabs of a data set's report: figures of each joint.

import { jointVar } from "../../colours.js";
import { h } from "../../dom.js";
import { count, number, percent, seconds, shortNames } from "../../format.js";
import { badge, card, facts, table } from "../../ui.js";
import { prose, sentences } from "./prose.js";

/** Rate, jitter, gaps, and the lag of the torque. */
export function timingTab({ report, joint_names: joints }) {
  return h("div", { class: "grid wide" }, timing(report), lag(report.lag, joints));
}

/** Motion of the joints, compared with their limits. */
export function excitationTab({ report, joint_names: joints }) {
  return [motion(report.excitation, joints), limits(report.limits, joints), ranges(report, joints)];
}

/** Identifiability of friction, torque compared with the robot's URDF, noise and saturation. */
export function frictionTab({ report, joint_names: joints }) {
  return [
    friction(report.excitation, joints),
    h("div", { class: "grid wide" }, againstRobot(report.against_robot, joints), noise(report, joints), saturation(report.saturation, joints)),
  ];
}

/** How the columns were read, and every preparation step. */
export function preparationTab({ report }) {
  return preparation(report);
}

/** Return a column of joint names in their colours. */
function jointColumn(joints) {
  const names = shortNames(joints);
  const cell = ({ joint }) => {
    const index = joints.indexOf(joint);
    return index < 0 ? joint : h("span", { class: "joint", style: `--own: ${jointVar(index)}` }, names[index]);
  };
  return { label: "Joint", cell };
}

/** Return a share as text on a bar. */
function bar(share, text = percent(share, 0)) {
  return share === null ? "–" : h("span", { class: "share", style: `--of: ${Math.max(0, Math.min(share, 1))}` }, text);
}

/** Labels and kinds of badges by the verdict of the report. */
const IDENTIFIABILITY = { well: ["identifiable", "good"], poorly: ["weak", "warn"], "not determined": ["unidentifiable", "bad"] };

function motion(found, joints) {
  const whole = found.whole;
  return card(
    "Joint motion",
    table(
      [
        jointColumn(joints),
        { label: "Range covered", cell: (row) => bar(row.visited) },
        { label: "Span, rad or m", numeric: true, cell: (row) => number(row.span) },
        { label: "Reversals", numeric: true, cell: (row) => count(row.reversals) },
        { label: "At rest", numeric: true, cell: (row) => percent(row.still, 0) },
        { label: "Forward / backward", numeric: true, cell: (row) => `${percent(row.forwards, 0)} / ${percent(row.backwards, 0)}` },
        { label: "Most collinear term", numeric: true, cell: (row) => `${row.collinear_term} ${percent(row.collinear, 0)}` },
      ],
      found.joints,
    ),
    whole
      ? h(
          "p",
          {},
          `${whole.rank} of ${whole.parameters} rigid-body base parameters are sufficiently excited. `,
          `The weakest is excited at ${percent(whole.weakest)} of the level of random motion; it belongs to the body that ${whole.weakest_body} moves.`,
        )
      : h("p", { class: "hint" }, "To check the excitation of the rigid bodies, upload the recording with a robot that has a URDF."),
    found.motion_dimensions == null
      ? null
      : h("p", {}, `The motion has ${number(found.motion_dimensions, 2)} independent dimensions of ${found.joints.length}. All joints are at rest in ${percent(found.standstill, 0)} of the samples.`),
    h("details", {}, h("summary", {}, "Description"), h("p", {}, prose(found.text))),
  );
}

function friction(found, joints) {
  const weight = (name) => (row) => {
    const { verdict, std, value, implausible } = row[name];
    const figure = value == null ? "" : ` ${number(value, 2)}`;
    return [implausible ? badge("implausible", "bad") : badge(...IDENTIFIABILITY[verdict]), figure, std === null ? "" : ` ±\u00a0${number(std, 2)}`];
  };
  const beside = found.friction_beside === "rigid bodies" ? "the torque of the robot’s rigid bodies" : "any torque that is a smooth function of the motion";
  return card(
    "Identifiability of friction",
    table(
      [
        jointColumn(joints),
        { label: "Viscous friction", cell: weight("viscous") },
        { label: "Coulomb friction", cell: weight("coulomb") },
        { label: "Constant torque", cell: weight("offset") },
      ],
      found.joints,
      { caption: `Estimated together with ${beside}; ±: one standard deviation` },
    ),
  );
}

function againstRobot(found, joints) {
  if (!found) return null;
  const times = (part) => (row) => (row[part] === null ? "–" : `${number(row[part], 3)} ± ${number(row[`${part}_std`], 2)}`);
  return card(
    `Torque compared with the URDF of ${found.robot}`,
    table(
      [
        jointColumn(joints),
        { label: "Gravity, ratio", numeric: true, cell: times("gravity") },
        { label: "Inertia, ratio", numeric: true, cell: times("inertia") },
        { label: "Explained with friction", cell: (row) => bar(row.explained) },
      ],
      found.joints,
      { caption: "1: equal to the URDF. Rotor inertia, which the URDF omits, increases inertia; a payload increases both. Explained: share of the variance" },
    ),
  );
}

function limits(rows, joints) {
  if (!rows.some((row) => [row.range_used, row.speed_used, row.torque_used].some((share) => share !== null))) return null;
  const used = (share, beyond) => (row) => {
    return row[beyond] > 0 ? badge(`${percent(row[share], 0)}, limit exceeded in ${percent(row[beyond], 2)}`, "bad") : bar(row[share]);
  };
  return card(
    "Use of the robot's limits",
    table(
      [
        jointColumn(joints),
        { label: "Range used", cell: used("range_used", "beyond_range") },
        { label: "Speed used", cell: used("speed_used", "beyond_speed") },
        { label: "Torque used", cell: used("torque_used", "beyond_torque") },
      ],
      rows,
      { caption: "A model extrapolates beyond the used range; 100 % is the limit" },
    ),
  );
}

function ranges(report, joints) {
  const between = (name) => (row) => `${number(report.ranges[name]?.min[row.index])} … ${number(report.ranges[name]?.max[row.index])}`;
  return card(
    "Ranges",
    table(
      [
        jointColumn(joints),
        { label: "q, rad or m", numeric: true, cell: between("q") },
        { label: "dq, per s", numeric: true, cell: between("dq") },
        { label: "ddq, per s²", numeric: true, cell: between("ddq") },
        { label: "tau, N·m or N", numeric: true, cell: between("tau") },
      ],
      joints.map((joint, index) => ({ joint, index })),
      { caption: "Minimum … maximum" },
    ),
  );
}

function noise(report, joints) {
  return card(
    "Noise",
    table(
      [
        jointColumn(joints),
        { label: "Torque, N·m", numeric: true, cell: (row) => (row.smoothed ? "smoothed" : number(row.torque, 2)) },
        { label: "of its std", numeric: true, cell: (row) => percent(row.torque_share) },
        { label: "Velocity, per s", numeric: true, cell: (row) => number(row.velocity, 2) },
        { label: "of its std", numeric: true, cell: (row) => percent(row.velocity_share) },
      ],
      report.noise,
      { caption: "Standard deviation of the white noise as recorded" },
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
            { label: "Joint", cell: (row) => (row.joint === null ? "all joints" : jointColumn(joints).cell(row)) },
            { label: "Lag, ms", numeric: true, cell: (row) => `${number(1e3 * row.seconds, 2)} ± ${number(1e3 * row.std_s, 2)}` },
            { label: "Error from the lag, share of variance", numeric: true, cell: (row) => percent(row.cost, 2) },
          ],
          known,
          { caption: "Negative: the torque precedes the motion; ±: one standard deviation" },
        )
      : null,
    [...why].map(([reason, who]) =>
      h("p", {}, `Lag unknown for ${who.map((row) => row.joint ?? "all joints").join(", ")}: `, reason),
    ),
  );
}

function timing(report) {
  const found = report.timing;
  return card(
    "Timing",
    facts([
      ["Rate as uploaded", found.rate_hz === null ? "unknown" : `${number(found.rate_hz, 4)} Hz`],
      ["Jitter, 50th / 99th percentile", `${percent(found.jitter_p50)} / ${percent(found.jitter_p99)}`],
      ["Max jitter", percent(found.jitter_max)],
      ["Gaps", count(report.gaps)],
      ["Rows dropped, repeated time", count(found.repeated_stamps)],
      ["Rows dropped, missing value", count(found.missing_rows)],
    ]),
    found.gaps.length
      ? table(
          [
            { label: "Starts at, s", numeric: true, cell: (row) => number(row.t, 6) },
            { label: "Duration", numeric: true, cell: (row) => seconds(row.seconds) },
          ],
          found.gaps,
          { caption: "Longest gaps (max 20)" },
        )
      : null,
  );
}

function saturation(rows, joints) {
  return card(
    "Possible saturation",
    table(
      [
        jointColumn(joints),
        { label: "At min or max torque", numeric: true, cell: (row) => percent(row.at_largest, 2) },
        { label: "Constant while moving", numeric: true, cell: (row) => (row.flat > 0 ? badge(percent(row.flat, 2), "warn") : percent(row.flat, 2)) },
        { label: "At torque limit", numeric: true, cell: (row) => (row.at_limit > 0 ? badge(percent(row.at_limit, 2), "warn") : percent(row.at_limit, 2)) },
      ],
      rows,
      { caption: "Share of samples with a torque that may be clipped" },
    ),
  );
}

function preparation(report) {
  const figures = { source: report.source, recipe: report.recipe, steps: report.steps };
  const steps = report.preparation.length ? sentences(report.preparation) : h("p", {}, "No changes.");
  return card(
    "Reading",
    report.reading.length ? sentences(report.reading) : null,
    h("h3", {}, "Preparation"),
    steps,
    h("details", {}, h("summary", {}, "All settings as JSON"), h("pre", {}, h("code", {}, JSON.stringify(figures, null, 2)))),
  );
}
