// The verdict on each joint: its error against the range of its torque, its coverage, the width of its intervals.

import { Term } from "./components.js";
import { count, number, percent, shortNames } from "./format.js";
import { Joint } from "./jointbars.js";
import { html } from "./preact.js";
import { JointBadge } from "./verdicts.js";

const NOMINAL = 0.95, LEAST = 0.5; // of the coverage: nominal value, bottom of the bar
const MEANS = 4; // length of a bar, relative to the error of the mean torque, if the range of the torque is unknown
const KINDS = { wrong: "bad", too_uncertain: "warn" };

/** The joints of a verdict, one a line, and how to read them. */
export function JointVerdicts({ verdict: { joints } }) {
  const names = shortNames(joints.map((each) => each.joint));
  return html`
    <div class="judged">
      <p class="head" aria-hidden="true"><span>Joint</span><span>Error, RMSE</span><span>95 % coverage</span><span>Width ÷ need</span><span>Verdict</span></p>
      <ul>${joints.map((each, index) => html`<${JointLine} key=${each.joint} joint=${each} index=${index} name=${names[index]} />`)}</ul>
    </div>
    <details class="hint">
      <summary>How to read this</summary>
      <p>Error (<${Term} of="rmse">RMSE<//>): its bar ends at the range of the torque${joints.some((each) => range(each) === null) ? `, or, where that is unknown, at ${MEANS} times the error of the mean torque` : ""}. The mark is the error of the mean torque, which needs no model.</p>
      <p>95 % <${Term} of="coverage">coverage<//>, from ${percent(LEAST, 0)} to 100 %. It should end at the mark. The thin line is its 95 % confidence interval.</p>
      <p><${Term} of="width">Width ÷ need<//>: it should be near 1.</p>
    </details>`;
}

function JointLine({ joint, index, name }) {
  return html`<li>
    <${Joint} index=${index} name=${name} />
    <${ErrorBar} joint=${joint} />
    <${CoverageBar} joint=${joint} />
    <span class="width"><span class="what">Width ÷ need </span>${joint.width_over_need === null ? "–" : number(joint.width_over_need, 2)}</span>
    <${JointBadge} joint=${joint} />
  </li>`;
}

function ErrorBar({ joint }) {
  const { unit, rmse, range_share: share, mean_rmse: mean, serving_rmse: serving, limit_share: limit, level } = joint;
  const full = range(joint) ?? (mean === null ? null : MEANS * mean);
  const at = (value) => `${100 * Math.min(value / full, 1)}%`;
  const others = [
    share === null ? null : `${percent(share, 1)} of the range of the torque`,
    mean === null ? null : `mean torque: ${number(mean, 2)} ${unit}`,
    serving === null ? null : `serving version: ${number(serving, 2)} ${unit}`,
    limit === null ? null : `${percent(limit, 1)} of the rated torque`,
  ].filter(Boolean);
  const label = `RMSE ${number(rmse, 2)} ${unit}${others.length ? `; ${others.join("; ")}` : ""}`;
  return html`<span class="measure" title=${label}>
    <span class="what">Error </span><span>${number(rmse, 2)} ${unit}${share !== null && html`<span class="muted"> ${percent(share, 1)}</span>`}</span>
    ${full !== null && html`<span class=${`inside ${KINDS[level] ?? ""}`} role="img" aria-label=${label}>
      <i class="filled" style=${`width: ${at(rmse)}`}></i>${mean !== null && html`<i class="due" style=${`left: ${at(mean)}`}></i>`}
    </span>`}
  </span>`;
}

function CoverageBar({ joint: { coverage, coverage_low: low, coverage_high: high, effective_samples: samples, level } }) {
  const at = (value) => 100 * Math.max(0, (value - LEAST) / (1 - LEAST));
  const known = low !== null && high !== null;
  const certain = known ? `, 95 % confidence interval ${percent(low, 0)} to ${percent(high, 0)}${samples === null ? "" : ` (${count(samples)} effective samples)`}` : "";
  const label = `95 % coverage: ${percent(coverage)}${certain}`;
  return html`<span class="measure" title=${label}>
    <span class="what">Coverage </span><span>${percent(coverage, 0)}${known && html`<span class="muted"> (${Math.round(100 * low)}–${Math.round(100 * high)})</span>`}</span>
    <span class=${`inside ${KINDS[level] ?? ""}`} role="img" aria-label=${label}>
      <i class="filled" style=${`width: ${at(coverage)}%`}></i>
      ${known && html`<i class="known" style=${`left: ${at(low)}%; width: ${at(high) - at(low)}%`}></i>`}
      <i class="due" style=${`left: calc(${at(NOMINAL)}% - 1px)`}></i>
    </span>
  </span>`;
}

/** Return the range of the torque; null if it is unknown. */
function range({ rmse, range_share: share }) {
  return share ? rmse / share : null;
}
