// Cards of the models; those that need attention come first.

import { Badge, Link } from "../../components.js";
import { ErrorBars, Course } from "../../bars.js";
import { ago, kilograms, seconds, sentence, shortNames } from "../../format.js";
import { html } from "../../preact.js";
import { VerdictBadge } from "../../verdicts.js";
import { Chain, Sketch } from "../arm/sketch.js";

const NEW_MS = 86_400_000;
const MIN_LAG_S = 1; // rows wait for less in normal operation
const PLAIN_NEWS = new Set(["promotion", "payload"]);

/** A card for each model of a page of `/v1/overview`. */
export function Models({ shown: { items, next_cursor: cursor, live_after_s: live } }) {
  const ranked = [...items].sort((one, other) => rank(one, live) - rank(other, live));
  return html`<section aria-label="Models">
    <ul class="robots">${ranked.map((model) => html`<${Model} key=${model.name} model=${model} isLive=${isLive(model, live)} />`)}</ul>
    ${cursor && html`<p><${Link} to="#/models">All models<//></p>`}
  </section>`;
}

function rank(model, live) {
  const reasons = [model.held, model.failure, model.serving_version !== null && model.verdict.level === "wrong", isLive(model, live), waits(model)];
  const first = reasons.findIndex(Boolean);
  return first < 0 ? reasons.length : first;
}

/** Return whether a version waits for approval. */
function waits({ candidate, serving_version: serving }) {
  return candidate !== null && candidate !== serving;
}

function isLive({ idle_s: idle }, live) {
  return idle !== null && idle < live;
}

function Model({ model, isLive: streams }) {
  const address = encodeURIComponent(model.name), names = shortNames(model.joint_names);
  return html`<li class="card robot" data-key=${model.name}>
    <div class="robot-head"><h2><${Link} to=${`#/models/${address}`}>${model.name}<//></h2> <${State} model=${model} isLive=${streams} /></div>
    <${Serving} model=${model} />
    <${News} model=${model} address=${address} />
    <div class=${model.verdict.joints.length ? "robot-body" : "robot-body unjudged"}>
      <${Arm} model=${model} address=${address} />
      ${model.verdict.joints.length > 0 && html`<${ErrorBars} joints=${model.verdict.joints} />`}
    </div>
    ${model.idle_s !== null && html`<${Stream} model=${model} names=${names} />`}
    <div class="actions robot-foot">
      <${Link} to=${`#/live/${address}`} label=${`Follow live: ${model.name}`}>Follow live<//>
      <${Link} to=${`#/train?model=${address}`} label=${`Retrain: ${model.name}`}>Retrain<//>
      <span class="hint">${model.estimator}, ${ago(model.created_at)}</span>
    </div>
  </li>`;
}

function State({ model, isLive: streams }) {
  if (model.held) return html`<${Badge} state="paused" />`;
  if (model.failure) return html`<${Badge} state="learning failed" kind="bad" />`;
  if (streams) return html`<span class="badge good live">live</span>`;
  return html`<span class="hint">${model.idle_s === null ? "no stream yet" : `idle for ${seconds(Math.round(model.idle_s))}`}</span>`;
}

/** Which version serves, and why. */
function Serving({ model: { serving_version: version, latest_version: latest, verdict } }) {
  const what = version === null ? `No version serves. Version ${latest} is a candidate` : `Version ${version} serves`;
  return html`<p>${what}: <${VerdictBadge} verdict=${verdict} /></p>
    <p class="hint clamped" title=${verdict.reason}>${verdict.reason}</p>`;
}

/** The learnt arm; joints in a row if none was learnt. */
function Arm({ model: { name, joint_names: joints, arm, position, estimator, serving_version: version, latest_version: latest }, address }) {
  if (!arm) return html`<a class="robot-arm" href=${`#/models/${address}?tab=arm`}><${Chain} n=${joints.length} label=${`${joints.length} joints`} /><span class="hint">${estimator} does not learn an arm</span></a>`;
  const label = `Learnt arm of ${name}, ${joints.length} joints`;
  return html`<a class="robot-arm" href=${`#/models/${address}?tab=arm`} aria-label=${`Arm of ${name}`}><${Sketch} key=${version ?? latest} arm=${arm} q=${position} label=${label} /></a>`;
}

/** Payload, lag and innovation of a model that has received rows. */
function Stream({ model: { payloads, lag_s: lag, recent }, names }) {
  const behind = lag === null ? "–" : lag >= MIN_LAG_S ? `${seconds(lag)} behind` : "up to date";
  return html`
    <dl class="robot-facts">
      <div><dt>Learning</dt> <dd>${behind}</dd></div>
      ${payloads?.map((each) => html`<div key=${each.stream_id}><dt>${payloads.length > 1 ? each.stream_id : "Payload"}</dt> <dd>${payloadText(each)}</dd></div>`)}
    </dl>
    ${recent?.course.length ? html`<${Course} names=${names} course=${recent.course} seconds=${recent.seconds} />` : html`<p class="hint">No rows in the last hour.</p>`}`;
}

function payloadText({ state, mass }) {
  return state === "contact" && mass === null ? "contact" : kilograms(mass);
}

/** What requires attention. */
function News({ model, address }) {
  const { held, failure, candidate, alarm, serving_version: version } = model;
  const isNew = alarm && !held && Date.now() - new Date(alarm.at).getTime() < NEW_MS;
  return html`
    ${held && html`<p class="robot-news">The robot may have changed. Learning is paused until you decide. <${Link} to=${`#/live/${address}`} label=${`Decide: ${model.name}`}>Decide<//></p>`}
    ${failure && html`<p class="robot-news">Learning failed: ${sentence(failure)}</p>`}
    ${waits(model) && html`<p class="robot-news">${version === null ? "It waits for your approval." : `Version ${candidate} is a candidate.`} <${Link} to=${`#/models/${address}?tab=versions`} label=${`Review version ${candidate} of ${model.name}`}>Review<//></p>`}
    ${isNew && html`<p class="robot-news clamped" title=${alarm.message}><${Badge} state=${PLAIN_NEWS.has(alarm.kind) ? alarm.kind : "warning"} kind=${PLAIN_NEWS.has(alarm.kind) ? "plain" : "warn"} /> ${sentence(alarm.message)} <span class="muted">${ago(alarm.at)}</span></p>`}`;
}
