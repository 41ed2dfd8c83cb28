// The live page: what streams measure and what was predicted before it was learnt, as it comes.

import { pages } from "../api.js";
import { h, refresh, replace } from "../dom.js";
import { count, counted } from "../format.js";
import { empty, heading, link, offer, select } from "../ui.js";
import { alarms } from "./live/alarms.js";
import { carriedCard } from "./live/carried.js";
import { follow } from "./live/connection.js";
import { innovation } from "./live/innovation.js";
import { moving } from "./live/moving.js";
import { quiet } from "./live/quiet.js";
import { Rows, WINDOW_S } from "./live/rows.js";
import { answersCard, learningCard, qualityCard } from "./live/standing.js";
import { torque } from "./live/torque.js";

const DRAW_MS = 300;
const MOST_MODELS = 500;
const STALE_S = 3;
const BREATH = 3; // times as long as drawing takes, nothing is drawn
const LONGEST_BREATH_MS = 1500;

/** The page `#/live`, where a model is chosen, and `#/live/{name}`. */
export async function render(view, { name }, { signal, title }) {
  title(name ? `${name} live` : "Live");
  const models = (await pages("/v1/models", MOST_MODELS, {}, signal)).map((model) => model.name);
  if (!models.length) {
    const said = "There is no model to follow yet. Upload a recording of your robot, then train a model on it.";
    replace(view, heading("Live"), empty(said, link("Upload a recording", "#/data", "primary")));
    return;
  }
  if (!name) {
    replace(
      view,
      heading("Live"),
      h("p", {}, "Follow a model while it answers and learns: measured and predicted torque, rows kept out of learning, and answer times."),
      h("ul", {}, models.map((each) => h("li", {}, link(each, address(each))))),
    );
    return;
  }
  await followed(view, name, models, signal);
}

/** Follow one model until the page is left; throws what the service refuses for good. */
async function followed(view, name, models, signal) {
  const page = parts(name, models);
  const seen = { rows: null, status: null, connection: null, pausedAt: null, drawn: 0, drawAt: 0, lost: 0 };
  const stream = streamChoice(seen);
  let plots = null;
  let drawing = false;

  const begin = (status) => {
    const joints = status.joint_names;
    if (seen.rows?.joints.join() === joints.join()) return;
    seen.rows = new Rows(joints);
    plots = [
      torque(page.torque, joints, status.joint_types, signal),
      moving(page.arm, name, () => seen.rows.pose(), signal),
      innovation(page.innovation, joints, signal),
    ];
    seen.drawn = -1;
  };
  const hear = (event, data) => {
    if (event === "lost") seen.lost += data.events;
    if (event === "rows") data.parts.forEach((part) => seen.rows?.take(part));
    if (event !== "status") return;
    begin(data);
    seen.status = data;
    data.novel.forEach((said) => seen.rows.mark(said));
    tell();
  };
  const tell = () => {
    said(page, seen, name);
    if (!seen.status) return;
    refresh(page.carried, carriedCard(seen.status));
    refresh(page.standing, learningCard(seen.status), qualityCard(seen.status), answersCard(seen.status));
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
      const shown = seen.rows.shown();
      for (const each of plots) await each.draw(shown, seen.status);
    } finally {
      drawing = false;
      // on a slow machine less often: the page stays usable
      seen.drawAt = Date.now() + Math.min(BREATH * (Date.now() - began), LONGEST_BREATH_MS);
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
  const again = () => (seen.drawn = -1);
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
function parts(name, models) {
  const page = Object.fromEntries(["state", "about", "quiet", "held", "carried", "standing", "alarms", "torque", "arm", "innovation"].map((each) => [each, h("div")]));
  page.state = h("p", { role: "status", class: "actions" });
  page.about.className = "hint";
  page.standing.className = "grid";
  page.pause = h("button", { type: "button" }, "Pause plots");
  page.streams = h("span");
  const choice = select(models.includes(name) ? models : [name, ...models], name, (chosen) => (location.hash = address(chosen)));
  choice.setAttribute("aria-label", "Model to follow");
  choice.style.width = "auto";
  page.plots = h("div", {}, page.torque, page.arm, page.innovation);
  page.all = [
    heading(`${name} live`, choice, page.streams, page.pause),
    page.state,
    page.about,
    page.held,
    page.quiet,
    page.carried,
    page.plots,
    page.standing,
    page.alarms,
  ];
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
  page.pause.hidden = page.plots.hidden = !rows?.came;
  page.torque.style.opacity = page.innovation.style.opacity = lost || age > STALE_S ? "0.75" : "";
  refresh(page.quiet, rows?.came || lost ? null : quiet(name, status));
  refresh(page.about, rows?.came ? about(seen, age) : null);
}

function about({ rows, lost, pausedAt }, age) {
  const rate = rows.rate();
  const texts = [
    `Stream ${rows.chosen}, the last ${WINDOW_S} s. `,
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

function address(name) {
  return `#/live/${encodeURIComponent(name)}`;
}
