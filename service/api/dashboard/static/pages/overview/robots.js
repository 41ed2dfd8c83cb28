// A card for each model: its arm, its stream, its quality, and what requires attention.

import { innovationCourse, qualityCharts } from "../../charts.js";
import { h, refresh } from "../../dom.js";
import { ago, kilograms, seconds, shortNames } from "../../format.js";
import { badge, link } from "../../ui.js";
import { chain, sketch } from "../arm/sketch.js";
import { figuresOf, verdictBadge } from "../verdict.js";

const NEW_MS = 86_400_000;
const BUCKETS = 60; // points of the last hour
const NEWS = { promotion: "promotion", payload: "payload" };

/** Create the cards. Returns show(page of `/v1/overview`), which updates them. */
export function robots(place) {
  const cards = new Map();
  const list = h("ul", { class: "robots" });
  const more = h("p", {});
  return ({ items, next_cursor: cursor, live_after_s: live }) => {
    if (!list.isConnected) place.append(h("section", { "aria-label": "Models" }, list, more));
    for (const name of cards.keys()) if (!items.some((each) => each.name === name)) cards.delete(name);
    const shown = [...items].sort((a, b) => rank(a, live) - rank(b, live));
    refresh(list, shown.map((model) => {
      const made = cards.get(model.name) ?? robotCard(model);
      cards.set(model.name, made);
      made.update(model, live);
      return made.element;
    }));
    refresh(more, cursor ? link("All models", "#/models") : null);
  };
}

function rank(model, live) {
  if (model.held || model.failure) return 0;
  return isLive(model, live) ? 1 : 2;
}

function isLive({ idle_s: idle }, live) {
  return idle !== null && idle < live;
}

function robotCard(first) {
  const address = encodeURIComponent(first.name);
  const state = h("span", {}), about = h("p", { class: "hint" }), charts = h("div", { class: "charts" });
  const lastHour = h("div", { class: "robot-course" }), news = h("div", { class: "robot-news" });
  const figure = h("a", { class: "robot-arm", href: `#/models/${address}?tab=arm`, "aria-label": `Arm of ${first.name}` });
  const body = h("div", { class: "robot-body" }, figure, charts);
  const element = h(
    "li",
    { class: "card robot", "data-key": first.name },
    h("div", { class: "robot-head" }, h("h2", {}, link(first.name, `#/models/${address}`)), state),
    about,
    body,
    lastHour,
    news,
    h("div", { class: "actions robot-foot" }, h("a", { href: `#/live/${address}`, "aria-label": `Follow live: ${first.name}` }, "Follow live"), h("a", { href: `#/train?model=${address}`, "aria-label": `Retrain: ${first.name}` }, "Retrain")),
  );
  let drawn = null, arm = null, posture = null;
  const update = (model, live) => {
    const names = shortNames(model.joint_names);
    refresh(state, streamState(model, live));
    refresh(about, model.serving_version === null ? "No version is serving; all are candidates. " : [verdictBadge(model.verdict), ` Version ${model.serving_version}, ${model.estimator}, created ${ago(model.created_at)}.`], model.candidate ? ` Version ${model.candidate} is a candidate.` : "");
    if (drawn !== model.serving_version) {
      drawn = model.serving_version;
      posture = JSON.stringify(model.position);
      arm = model.arm && sketch(model.arm, model.position, `Learnt arm of ${model.name}, ${names.length} joints`);
      const unknown = [chain(names.length, `${names.length} joints`), h("span", { class: "hint" }, `${model.estimator} does not learn an arm`)];
      figure.replaceChildren(...(arm ? [arm.element] : unknown));
      if (arm) figure.setAttribute("aria-label", `Arm of ${first.name}`);
      else figure.removeAttribute("aria-label"); // its text is its name
    } else if (posture !== JSON.stringify(model.position)) {
      posture = JSON.stringify(model.position);
      arm?.glide(model.position);
    }
    body.classList.toggle("unjudged", !figuresOf(model.verdict) && !model.recent?.rows);
    refresh(charts, qualityParts(model, names));
    refresh(lastHour, recentInnovation(model, names));
    refresh(news, newsItems(model, address));
  };
  return { element, update };
}

function streamState(model, live) {
  if (model.held) return badge("paused");
  if (model.failure) return badge("learning failed", "bad");
  if (isLive(model, live)) return h("span", { class: "badge good live" }, "live");
  return h("span", { class: "hint" }, model.idle_s === null ? "no stream yet" : `idle for ${seconds(Math.round(model.idle_s))}`);
}

function qualityParts({ verdict, recent }, names) {
  const judged = figuresOf(verdict);
  const lastHour = recent?.rows ? recent : null;
  if (!judged && !lastHour) return h("p", { class: "hint" }, "Not evaluated: no rows were held out, and no stream was received.");
  const note = judged && lastHour ? "Bars: held-out rows. Lines: last hour." : judged ? "On held-out rows." : "In the last hour.";
  return [qualityCharts(names, judged ?? lastHour, judged ? lastHour : null), h("p", { class: "hint" }, note)];
}

function recentInnovation({ recent }, names) {
  if (!recent?.course.length) return null;
  const now = Date.now() / 1000;
  return [
    h("div", { class: "chart-label" }, h("span", {}, "Innovation, last hour"), h("span", { class: "hint" }, "dashed: 1 σ")),
    innovationCourse(names, recent.course, recent.seconds, Math.max(now, recent.course.at(-1).at), Math.max(recent.seconds / BUCKETS, 1)),
  ];
}

function newsItems(model, address) {
  const found = [];
  if (model.held) found.push([badge("paused"), " The robot may have changed. Learning is paused until you decide. ", link("Decide", `#/live/${address}`)]);
  if (model.failure) found.push([badge("error"), ` Learning failed: ${model.failure}`]);
  for (const { stream_id: stream, mass } of model.payloads ?? []) {
    if (mass) found.push([badge("payload", "plain"), ` ${stream}: payload ${kilograms(mass)}.`]);
  }
  const { alarm } = model;
  const isShown = alarm?.kind === "payload" && found.length > 0; // the payload is shown already
  if (alarm && !isShown && !model.held && Date.now() - new Date(alarm.at).getTime() < NEW_MS) {
    found.push([badge(NEWS[alarm.kind] ?? "warning", NEWS[alarm.kind] ? "plain" : "warn"), ` ${alarm.message} `, h("span", { class: "muted" }, ago(alarm.at))]);
  }
  return found.map((each) => h("p", {}, each));
}
