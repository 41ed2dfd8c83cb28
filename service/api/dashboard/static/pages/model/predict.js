// Torque of a state that the reader sets with sliders, with its interval and its components.

import { post } from "../../api.js";
import { Badge, Button, Card, ErrorBox, Loading } from "../../components.js";
import { shortNames } from "../../format.js";
import { Joint } from "../../jointbars.js";
import { latest } from "../../latest.js";
import { html, useEffect, useMemo, useState } from "../../preact.js";
import { Answer } from "./answer.js";
import { offered } from "./components.js";
import { Dial, middle } from "./dial.js";

const QUANTITIES = [["q", ["rad", "m"]], ["dq", ["rad/s", "m/s"]], ["ddq", ["rad/s²", "m/s²"]]];

/** The tab. */
export function Predict({ where, version }) {
  const rest = useMemo(() => atRest(version), []);
  const [motion, setMotion] = useState(rest), [answer, setAnswer] = useState(null), [error, setError] = useState(null);
  const stop = useMemo(() => new AbortController(), []);
  const ask = useMemo(() => latest(async (asked) => {
    try {
      const found = await post(`${where}/predict`, { ...asked, version: version.version, components: offered(version) }, stop.signal);
      setAnswer({ found, asked });
      setError(null);
    } catch (failure) {
      if (!stop.signal.aborted) setError(failure);
    }
  }), []);
  useEffect(() => () => stop.abort(), []);
  useEffect(() => void ask(motion), [motion]);
  return html`
    <${Card} title="State" kind="state">
      <p class="hint">Sliders end at the training range; a number may lie outside. <${Button} onclick=${() => setMotion(rest)}>At rest, middle of the range<//></p>
      <${Dials} version=${version} motion=${motion} onchange=${setMotion} />
    <//>
    <${Card} title="Predicted torque">
      ${error && html`<${ErrorBox} error=${error} />`}
      ${answer ? html`<${Answer} ...${answer} version=${version} outside=${outside(version, answer.asked)} />` : !error && html`<${Loading} what="Predicting" />`}
    <//>`;
}

function Dials({ version, motion, onchange }) {
  const { joint_names: names, joint_types: types, training_range: range } = version;
  const short = shortNames(names), beyond = outside(version, motion);
  const dial = (joint) => ([quantity, units]) => html`<${Dial} key=${quantity} name=${`${quantity} of ${names[joint]}`} label=${quantity} unit=${units[types[joint] === "prismatic" ? 1 : 0]}
    low=${range[quantity].min[joint]} high=${range[quantity].max[joint]} value=${motion[quantity][joint]}
    onchange=${(value) => onchange({ ...motion, [quantity]: motion[quantity].with(joint, value) })} />`;
  return html`<ul class="states">${names.map((name, joint) => html`<li key=${name}>
    <span><${Joint} index=${joint} name=${short[joint]} /> ${beyond[joint].length > 0 && html`<${Badge} state=${`${beyond[joint].join(", ")} outside`} kind="warn" />`}</span>
    ${QUANTITIES.map(dial(joint))}
  </li>`)}</ul>`;
}

/** Return the state at rest in the middle of the training range. */
function atRest({ joint_names: names, training_range: { q } }) {
  const zero = names.map(() => 0);
  return { q: names.map((_name, joint) => middle(q.min[joint], q.max[joint])), dq: zero, ddq: zero };
}

/** Return the quantities of each joint that are outside the training range. */
function outside({ joint_names: names, training_range: range }, motion) {
  return names.map((_name, joint) => QUANTITIES.map(([quantity]) => quantity).filter((quantity) => motion[quantity][joint] < range[quantity].min[joint] || motion[quantity][joint] > range[quantity].max[joint]));
}
