// A predicted torque: for each joint its 95 % band and its components in one bar, and all numbers.

import { Table } from "../../components.js";
import { number, percent, shortNames, torqueUnit } from "../../format.js";
import { Joint } from "../../jointbars.js";
import { html } from "../../preact.js";
import { componentColour, componentLabel } from "./components.js";
import { Z95 } from "./curves.js";

/** The answer. found: of the service; outside: quantities of each joint outside the training range. */
export function Answer({ found, outside, version }) {
  const { joint_names: names, tau, fallback } = found, short = shortNames(names);
  const parts = partsOf(found), half = names.map((_name, joint) => Z95 * totalStd(found, joint));
  const falling = names.map((_name, joint) => fallback?.[joint] ?? 0);
  return html`
    ${outside.some((each) => each.length) && html`<p class="banner" role="note">This state is partly outside the training range. The version extrapolates: its interval grows, but not always enough. Do not send this torque to a robot without a check.</p>`}
    ${falling.some((share) => share > 0) && html`<p class="banner" role="note">The training does not determine this motion. The torque falls back to gravity and friction: ${short.map((name, joint) => [name, falling[joint]]).filter(([, share]) => share > 0).map(([name, share]) => `${name} ${percent(share, 0)}`).join(", ")}.</p>`}
    <p class="key" aria-hidden="true">
      ${parts.map(([name]) => html`<span><i class="sample" style=${`background: var(--${componentColour(name)})`}></i>${componentLabel(name)}</span>`)}
      <span><i class="sample mark"></i>torque, 95 % band</span>
    </p>
    <ul class="answer">${names.map((name, joint) => html`<li key=${name}>
      <${Joint} index=${joint} name=${short[joint]} />
      <strong class="numeric">${fixed(tau[joint], half[joint])} ± ${fixed(half[joint], half[joint])} ${torqueUnit(version.joint_types[joint])}</strong>
      <${Stack} parts=${parts.map(([part, values]) => [part, values[joint]])} tau=${tau[joint]} half=${half[joint]} unit=${torqueUnit(version.joint_types[joint])} />
    </li>`)}</ul>
    <p class="hint">Each bar has its own scale; its grey line is zero. Components to the right of it are positive. The band contains 95 % of the measurements.</p>
    <details><summary>All numbers</summary><${Numbers} found=${found} parts=${parts} half=${half} version=${version} /></details>`;
}

/** The components of a joint from zero to both sides, with the torque and its band above them. */
function Stack({ parts, tau, half, unit }) {
  const sum = (sign) => parts.reduce((all, [, value]) => all + Math.max(sign * value, 0), 0);
  const low = Math.min(-sum(-1), tau - half, 0), high = Math.max(sum(1), tau + half, 0);
  const at = (value) => (100 * (value - low)) / (high - low || 1);
  let [down, up] = [0, 0];
  const bars = parts.map(([name, value]) => {
    const from = value < 0 ? (down += value) : (up += value) - value;
    return html`<i style=${`left: ${at(from)}%; width: ${at(Math.abs(value)) - at(0)}%; background: var(--${componentColour(name)})`}></i>`;
  });
  const label = `${number(tau)} ± ${number(half, 2)} ${unit}: ${parts.map(([name, value]) => `${componentLabel(name)} ${number(value)}`).join(", ")}`;
  return html`<span class="stack" role="img" aria-label=${label} title=${label}>
    ${bars}<i class="zero" style=${`left: ${at(0)}%`}></i>
    <i class="band" style=${`left: ${at(tau - half)}%; width: ${at(tau + half) - at(tau - half)}%`}></i><i class="due" style=${`left: calc(${at(tau)}% - 1px)`}></i>
  </span>`;
}

function Numbers({ found, parts, half, version }) {
  const { joint_names: names, tau, tau_std: std, noise_std: noise } = found, short = shortNames(names);
  const numeric = (label, cell) => ({ label, numeric: true, cell });
  const columns = [
    { label: "Joint", cell: (joint) => html`<${Joint} index=${joint} name=${short[joint]} />` },
    numeric("Torque, N·m", (joint) => fixed(tau[joint], std[joint])),
    numeric("± of the model", (joint) => number(std[joint], 2)),
    numeric("± of the noise", (joint) => number(noise[joint], 2)),
    numeric("95 % band", (joint) => `± ${fixed(half[joint], half[joint])}`),
    ...parts.map(([name, values]) => numeric(componentLabel(name), (joint) => number(values[joint]))),
  ];
  const gravity = version.parameters.geometry?.gravity;
  const revision = found.revision ? `, revision ${found.revision}` : "";
  return html`
    <${Table} columns=${columns} rows=${names.map((_name, joint) => joint)} caption=${`Version ${found.version}${revision}, ${found.torque_convention.replace("_", " ")}; ±: one standard deviation`} />
    ${gravity && html`<p class="hint">Gravity in the frame of the base: ${Math.hypot(...gravity) ? `(${gravity.map((each) => each.toFixed(2)).join(", ")}) m/s²` : "not part of this torque"}.</p>`}`;
}

/** Return the components [[name, values by joint], …]; what they leave of the torque is the last. */
function partsOf({ components, tau }) {
  const named = Object.entries(components).map(([name, { mean }]) => [name, mean]);
  const rest = tau.map((each, joint) => each - named.reduce((sum, [, values]) => sum + values[joint], 0));
  return rest.some((each, joint) => Math.abs(each) > 1e-6 * Math.max(Math.abs(tau[joint]), 1)) ? [...named, ["rest", rest]] : named;
}

/** Return the standard deviation of a measurement. */
function totalStd({ tau_std: std, noise_std: noise, scale }, joint) {
  return scale[joint] * Math.hypot(std[joint], noise[joint]);
}

/** Format a number with the decimals of the two leading digits of its uncertainty. */
function fixed(value, uncertainty) {
  const decimals = uncertainty > 0 ? Math.min(8, Math.max(0, 1 - Math.floor(Math.log10(uncertainty)))) : 4;
  return value.toFixed(decimals).replace("-", "−");
}
