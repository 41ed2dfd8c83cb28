// Learnt arm of a version: a 3-D drawing with an adjustable posture, and tables of its parameters.

import { Button, Card, Drawn } from "../../components.js";
import { number, shortNames } from "../../format.js";
import { Joint, JointKey } from "../../jointbars.js";
import { latest } from "../../latest.js";
import { html, useMemo, useRef, useState } from "../../preact.js";
import { AMBIGUITY_NOTE, drawable, drawing, LEGEND } from "../arm/drawing.js";
import { AxisTable, ParameterTable } from "../arm/tables.js";
import { Dial, middle } from "./dial.js";
import { ARM_FORMATS, exportVersion, FUNCTION_FORMATS } from "./export.js";

const DEGREES = 180 / Math.PI;
const WIDE = 500; // px

/** The tab. */
export function Arm({ model: { name }, version }) {
  const { inertia, geometry } = version.parameters;
  return html`
    ${inertia
      ? html`<${Card} title="Learnt arm">
          ${drawable() ? html`<${Figure} version=${version} />` : html`<p class="hint">3-D drawing is not available: WebGL is off in this browser. The tables contain the same values.</p>`}
          <details class="hint"><summary>How to read this</summary><p>${LEGEND}${orientationNote(geometry.gravity)} ${AMBIGUITY_NOTE}</p></details>
          <${Exports} name=${name} version=${version.version} formats=${{ ...ARM_FORMATS, ...FUNCTION_FORMATS }} />
        <//>`
      : html`<p class="empty">This version has no arm: its estimator does not learn rigid bodies. Train a version with the estimator rigid-body.</p><${Exports} name=${name} version=${version.version} formats=${FUNCTION_FORMATS} />`}
    <${Card} title=${inertia ? "Masses and friction" : "Friction"}><${ParameterTable} version=${version} /><p class="hint">${inertia && massNote(inertia)}${FRICTION_NOTE}</p><//>
    ${inertia && html`<${Card} title="Axes and centres of mass"><${AxisTable} version=${version} /><//>`}`;
}

const FRICTION_NOTE = "Friction is viscous · dq + Coulomb · sign(dq) + offset; the offset includes every other constant torque. Grey values are within two standard deviations of zero. Values as trained, without online learning.";

/** Buttons that save the version in these formats. */
function Exports({ name, version, formats }) {
  return html`<div class="actions">${Object.entries(formats).map(([format, label]) => html`<${Button} key=${format} onclick=${() => exportVersion(name, version, format)}>Save as ${label}<//>`)}</div>`;
}

function Figure({ version }) {
  const { joint_names: names, joint_types: types, training_range: { q: range } } = version;
  const short = shortNames(names);
  const start = useMemo(() => range.min.map((low, joint) => middle(low, range.max[joint])), []);
  const [q, setQ] = useState(start), made = useRef(null);
  const show = useMemo(() => latest(async (positions) => made.current && (await made.current.draw(positions))), []);
  const move = (positions) => {
    setQ(positions);
    show(positions);
  };
  const draw = async (place, signal) => {
    made.current = await drawing(place, version, start, { height: place.clientWidth > WIDE ? 520 : 420, signal });
  };
  const dial = (name, joint) => {
    const scale = types[joint] === "prismatic" ? 1 : DEGREES, round = (value) => Number((scale * value).toFixed(scale === 1 ? 3 : 1));
    return html`<${Dial} key=${name} name=${`Position of ${name}`} label=${html`<${Joint} index=${joint} name=${short[joint]} />`} unit=${scale === 1 ? "m" : "°"}
      low=${round(range.min[joint])} high=${round(range.max[joint])} value=${round(q[joint])} onchange=${(value) => move(q.with(joint, value / scale))} />`;
  };
  return html`<div class="arm-stage">
    <div><${Drawn} draw=${draw} inputs=${[version]} kind="arm" /><${JointKey} names=${short} /></div>
    <div class="dials"><h3>Posture</h3>${names.map(dial)}<${Button} onclick=${() => move(start)}>Reset posture<//></div>
  </div>`;
}

function massNote({ mean_is_plausible: plausible, plausible_deviation: deviation }) {
  const differs = deviation?.some(Boolean) ? `; their torque differs by up to ${number(Math.max(...deviation), 2)} N·m (RMS, worst joint)` : "";
  return `${plausible ? "The masses are physically consistent" : `The masses are the physically consistent ones nearest to the estimate${differs}`}. Torque depends on sums of masses, rarely on a single one: unidentifiable ones come from the prior. `;
}

function orientationNote(gravity) {
  if (!Math.hypot(...gravity)) return " The torque does not include gravity, so the orientation of the base is unknown.";
  return Math.hypot(gravity[0], gravity[1]) > 1e-6 || gravity[2] > 0 ? " The arm is rotated so that gravity points downwards." : "";
}
