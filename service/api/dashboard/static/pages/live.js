// The live page: which robots stream now, and of one model what streams measure and what was predicted, as it comes.

import { pages } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { count, counted } from "../format.js";
import { Linked } from "../linked.js";
import { plotly } from "../plots.js";
import { card, heading, offer, select } from "../ui.js";
import { alarmMarks, alarms } from "./live/alarms.js";
import { carriedCard, externalCard } from "./live/carried.js";
import { follow } from "./live/connection.js";
import { innovation } from "./live/innovation.js";
import { moving } from "./live/moving.js";
import { quiet } from "./live/quiet.js";
import { address, robots } from "./live/robots.js";
import { Rows } from "./live/rows.js";
import { learningFacts, qualityCard, vitals } from "./live/standing.js";
import { switches } from "./live/switches.js";
import { toolbar } from "./live/toolbar.js";
import { torque } from "./live/torque.js";

const DRAW_MS = 300;
const MOST_MODELS = 500;
const STALE_S = 3;
const BREATH = 3; // times as long as drawing takes, nothing is drawn
const LONGEST_BREATH_MS = 1500;

/** The page `#/live`, where robots are listed, and `#/live/{name}`; `?window=120&joint=joint4` chooses what is seen. */
export async function render(view, { name, query }, { signal, title }) {
  title(name ? `${name} live` : "Live");
  if (!name) return robots(view, signal);
  const models = (await pages("/v1/models", MOST_MODELS, {}, signal)).map((model) => model.name);
  await followed(view, name, models, query, signal);
}

/** Follow one model until the page is left; throws what the service refuses for good. */
async function followed(view, name, models, query, signal) {
  const learning = switches(name, signal);
  const page = parts(name, models, learning.element);
  const seen = { rows: null, status: null, connection: null, pausedAt: null, drawn: 0, drawAt: 0, lost: 0 };
  const choice = { window: 30, joint: null, cursor: null };
  const stream = streamChoice(seen);
  let plots = null, drawing = false;
  plotly(); // is needed as soon as rows come

  const again = () => {
    seen.drawn = -1;
    seen.drawAt = 0;
  };
  const point = (x) => {
    choice.cursor = x;
    linked.point(x);
    tools?.point(x);
    plots?.torque.point();
  };
  const linked = new Linked({ moved: point, stays: false });
  let tools = null;

  const begin = (status) => {
    const { joint_names: joints, joint_types: types } = status;
    if (seen.rows?.joints.join() === joints.join()) return;
    seen.rows = new Rows(joints);
    tools = toolbar(name, joints, choice, query, { changed: again, point });
    replace(page.tools, tools.element);
    const pick = (joint) => tools.pick(joint);
    plots = {
      torque: torque(page.torque, joints, types, choice, linked, { pick, signal }),
      innovation: innovation(page.innovation, joints, choice, linked, signal),
      arm: moving(page.arm, name, () => seen.rows.pose(), signal),
    };
    again();
  };
  const hear = (event, data) => {
    if (event === "lost") seen.lost += data.events;
    if (event === "rows") data.parts.forEach((part) => seen.rows?.take(part));
    if (event !== "status") return;
    begin(data);
    seen.status = data;
    data.novel.forEach((said) => seen.rows.mark(said));
    learning.look(data);
    tell();
  };
  const tell = () => {
    said(page, seen, name);
    if (!seen.status) return;
    page.standing.hidden = false;
    refresh(page.carried, carriedCard(seen.status));
    refresh(page.learning, learningFacts(seen.status));
    refresh(page.quality, qualityCard(seen.status));
    refresh(page.vitals, vitals(seen.status));
    alarms(page, seen.status, name, signal);
    const names = seen.rows.streams();
    refresh(page.streams, names.length < 2 ? null : offer(stream, names, seen.rows.chosen));
  };
  const draw = async () => {
    if (!seen.rows?.came || drawing || seen.pausedAt !== null || document.hidden || seen.drawn === seen.rows.version) return;
    if (Date.now() < seen.drawAt) return;
    drawing = true;
    seen.drawn = seen.rows.version;
    const began = Date.now();
    try {
      page.plots.hidden = false; // a plot takes its width from a place that is seen
      const shown = seen.rows.shown(choice.window);
      const joint = await plots.torque.draw(shown);
      linked.mark(alarmMarks(seen.status.alarms, seen.rows.chosen, seen.rows.newest()));
      refresh(page.external, externalCard(shown, seen.rows.joints, seen.status.joint_types));
      await plots.arm.draw(seen.status, joint);
      await plots.innovation.draw(shown, seen.status, joint);
    } finally {
      drawing = false;
      // on a slow machine less often: the page stays usable
      if (seen.drawn !== -1) seen.drawAt = Date.now() + Math.min(BREATH * (Date.now() - began), LONGEST_BREATH_MS);
    }
  };
  page.pause.addEventListener("click", () => {
    seen.pausedAt = seen.pausedAt === null ? Date.now() : null;
    page.pause.textContent = seen.pausedAt === null ? "Pause plots" : "Go on";
    tell();
  });

  replace(view, page.all);
  tell();
  const timers = [setInterval(draw, DRAW_MS), setInterval(() => said(page, seen, name), 1000)];
  document.addEventListener("themechange", again);
  signal.addEventListener("abort", () => {
    timers.forEach(clearInterval);
    document.removeEventListener("themechange", again);
  });
  await follow(name, signal, hear, (connection) => {
    seen.connection = connection;
    tell();
  });
}

/** The places of the page. */
function parts(name, models, learning) {
  const places = ["about", "quiet", "held", "carried", "external", "learning", "quality", "vitals", "alarms", "tools", "torque", "arm", "innovation"];
  const page = Object.fromEntries(places.map((each) => [each, h("div")]));
  page.state = h("p", { role: "status", class: "actions" });
  page.about.className = "hint";
  page.pause = h("button", { type: "button" }, "Pause plots");
  page.streams = h("span");
  const choice = select(models.includes(name) ? models : [name, ...models], name, (chosen) => (location.hash = address(chosen)));
  choice.setAttribute("aria-label", "Model to follow");
  choice.style.width = "auto";
  page.plots = h("div", { hidden: true }, page.tools, page.torque, page.innovation);
  const stage = h("div", { class: "stage" }, page.plots, h("div", { class: "aside" }, page.arm, page.carried, page.external));
  page.standing = h("div", { class: "grid wide", hidden: true }, card("Learning", learning, page.learning), page.quality);
  const top = h("div", { class: "now" }, h("div", {}, page.state, page.about), page.vitals);
  page.all = [heading(`${name} live`, choice, page.streams, page.pause), top, page.held, page.quiet, stage, page.standing, page.alarms];
  return page;
}

/** Say how old what is shown is, and how much of it. */
function said(page, seen, name) {
  const { rows, status, connection } = seen;
  const age = rows?.age() ?? null;
  const lost = connection?.state === "lost";
  const words = [];
  if (!connection) words.push(["busy", "◌ connecting"]);
  else if (lost) words.push(["bad", `✕ connection lost: ${connection.why}. What is shown is old. Trying again`]);
  else if (!rows?.came) words.push(["plain", "· connected, no rows yet"]);
  else if (age > STALE_S) words.push(["warn", "! no new rows: what is shown is old"]);
  else words.push(["good", "✓ live"]);
  if (seen.pausedAt !== null) words.push(["warn", "! plots paused, rows still come"]);
  refresh(page.state, ...words.map(([kind, text]) => h("span", { class: `badge ${kind}`, style: "white-space: normal" }, text)));
  page.pause.hidden = !rows?.came;
  page.plots.classList.toggle("old", lost || age > STALE_S);
  refresh(page.quiet, rows?.came || lost ? null : quiet(name, status));
  refresh(page.about, rows?.came ? about(seen, age) : null);
}

function about({ rows, lost, pausedAt }, age) {
  const rate = rows.rate();
  const texts = [
    `Stream ${rows.chosen}. `,
    age > STALE_S ? `The newest row came ${Math.round(age)} s ago. ` : null,
    rate ? `${counted(Math.round(rate.came), "row")} come in each second. This page shows ${count(Math.round(rate.shown))} of them, those kept out of learning first. ` : null,
    pausedAt === null ? null : `Plots are paused since ${new Date(pausedAt).toLocaleTimeString("en-GB")}. `,
    lost ? `This page was too slow and missed ${counted(lost, "event")}. ` : null,
  ];
  return h("p", {}, texts);
}

/** A choice of streams, where there are several. */
function streamChoice(seen) {
  const made = select([], null, (name) => {
    seen.rows.choose(name);
    seen.drawn = -1;
  });
  made.setAttribute("aria-label", "Stream to show");
  made.style.width = "auto";
  return made;
}
