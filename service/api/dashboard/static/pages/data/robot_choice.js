// Choice of a robot: a known one or an uploaded URDF. Used for uploads and training.

import { get, pages, upload } from "../../api.js";
import { Button, ErrorBox, Field } from "../../components.js";
import { MissingExtra, useMissing } from "../../extras.js";
import { counted } from "../../format.js";
import { html, useRef, useState } from "../../preact.js";
import { notice } from "../../dialogs.js";
import { Prose } from "../../prose.js";

/** Meanings of the effort of a recording. */
export const EFFORTS = {
  measured: "measured torque, gravity included",
  commanded: "commanded torque, added to gravity compensation",
  current: "motor current (requires torque constants)",
  unknown: "unknown for this robot: choose its meaning",
};
const MOST = 200;

/** Read the robots, as {profiles, uploaded}. */
export async function readRobots(signal) {
  const [known, uploaded] = await Promise.all([get("/v1/robots/profiles", {}, signal), pages("/v1/robots", MOST, {}, signal)]);
  return { profiles: known.items, uploaded };
}

/**
 * A select of robots with a note on the chosen one, and a button that uploads a URDF and chooses it.
 * reading: of `readRobots` by `useRead`; none: text for no robot; withUrdf: list only robots with a URDF;
 * disabled: why none can be chosen, "" if one can.
 */
export function RobotChoice({ reading, value, onchange, none, withUrdf = false, disabled = "", hint }) {
  const { profiles = [], uploaded = [] } = reading.value ?? {};
  const usable = profiles.filter((each) => !withUrdf || each.urdf_available);
  const profile = profiles.find((each) => each.name === value);
  const there = usable.some((each) => each.name === value) || uploaded.some((each) => each.id === value);
  const group = (label, options) => options.length > 0 && html`<optgroup label=${label}>${options.map(([each, text]) => html`<option key=${each} value=${each} selected=${each === value}>${text}</option>`)}</optgroup>`;
  const select = (attributes) => html`<select ...${attributes} name="robot" title=${profile?.title} disabled=${Boolean(disabled)} onChange=${(event) => onchange(event.target.value)}>
    <option value="" selected=${!there}>${none}</option>
    ${group("Known robots", usable.map((each) => [each.name, `${each.name} – ${each.title}`]))}
    ${group("Uploaded URDFs", uploaded.map((each) => [each.id, `${each.name} (${each.id})`]))}
  </select>`;
  const missing = value && !there && reading.value ? `${value} has no URDF here, so it cannot be chosen. ` : "";
  return html`<${Field} label="Robot" hint=${disabled || `${missing}${hint}`} input=${select} />
    ${!disabled && html`
      ${profile && there && html`<p class="hint"><${Prose} text=${describe(profile, withUrdf)} /></p>`}
      ${reading.error && html`<${ErrorBox} error=${reading.error} retry=${reading.reload} />`}
      <${AddUrdf} onadded=${(robot) => (reading.reload(), onchange(robot.id))} />`}`;
}

function describe(profile, withUrdf) {
  const joints = `${counted(profile.joints.length, "joint")}: ${profile.joints.map((each) => each.name).join(", ")}.`;
  return withUrdf ? joints : `${joints} Its effort: ${EFFORTS[profile.effort]}. ${profile.effort_note}`;
}

/** A button that uploads a URDF and then calls onadded(robot). */
function AddUrdf({ onadded }) {
  const input = useRef(null);
  const [problem, setProblem] = useState(null);
  const missing = useMissing("robots");
  // scale: factors to SI units that an error message proposed
  const send = async (file, scale) => {
    setProblem(null);
    try {
      const robot = await upload(file, { scale }, undefined, undefined, "/v1/robots");
      notice(`${robot.name} added, ${counted(robot.joints.length, "joint")}.`);
      onadded(robot);
    } catch (error) {
      setProblem({ file, error, scale: /set scale=([\w=.,-]+)/.exec(error.message)?.[1] });
    }
  };
  const pick = (event) => {
    const [file] = event.target.files;
    if (file) send(file, "");
    event.target.value = "";
  };
  return html`<div class="field">
    <div class="actions"><${Button} onclick=${() => input.current.click()} disabled=${Boolean(missing)}>Add a URDF<//>
      <input type="file" accept=".urdf,.xacro,.sdf,.xml,.zip" hidden aria-label="URDF to upload" ref=${input} onChange=${pick} /></div>
    <${MissingExtra} missing=${missing} />
    ${problem && html`<${ErrorBox} error=${problem.error} />
      ${problem.scale && html`<div class="actions"><${Button} onclick=${() => send(problem.file, problem.scale)}>Upload in these units<//></div>`}`}
  </div>`;
}
