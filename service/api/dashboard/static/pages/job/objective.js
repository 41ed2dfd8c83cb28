// Plot of the objective of a fit over its iterations, from the updates that this page received.

import { line, plot } from "../../plots.js";

/** Points by job, kept while the dashboard is open, so that the curve continues after a return to the job. */
const seen = new Map();
const MAX_JOBS = 20;

/** Plot of a job's objective. Each attempt of a restarted job has its own curve. */
export class Objective {
  #place;
  #signal;
  #drawn = null;
  #drawing = false;
  #next = null;

  constructor(place, signal) {
    this.#place = place;
    this.#signal = signal;
  }

  /** Return the number of iterations in the plot. */
  static points(id) {
    return [...(seen.get(id)?.values() ?? [])].reduce((sum, { x }) => sum + x.length, 0);
  }

  /** Return the first iteration in the plot; null if there is none. */
  static first(id) {
    const [curve] = seen.get(id)?.values() ?? [];
    return curve?.x[0] ?? null;
  }

  /** Add the progress of a job; return whether it has a new point. */
  add(job) {
    const { objective, iteration, estimator } = job.progress;
    if (objective === null || objective === undefined || !iteration) return false;
    const curves = curvesOf(job.id);
    const key = JSON.stringify([job.attempts, estimator ?? null]);
    if (!curves.has(key)) curves.set(key, { attempt: job.attempts, estimator: estimator ?? null, x: [], y: [] });
    const curve = curves.get(key);
    if (curve.x.at(-1) >= iteration) return false;
    curve.x.push(iteration);
    curve.y.push(objective);
    return true;
  }

  /** Draw the plot. If updates arrive faster than they can be drawn, only the last one is drawn. */
  async draw(job) {
    this.#next = job;
    if (this.#drawing) return;
    this.#drawing = true;
    try {
      while (this.#next) {
        const now = this.#next;
        this.#next = null;
        await this.#draw(now);
      }
    } finally {
      this.#drawing = false;
    }
  }

  async #draw(job) {
    const all = [...curvesOf(job.id).values()];
    if (this.#signal.aborted || !all.length) return;
    // objectives of different estimators are not comparable: show the current estimator, or the last one
    const { estimator } = all.find((each) => each.estimator === job.progress.estimator) ?? all.at(-1);
    const curves = all.filter((each) => each.estimator === estimator);
    const name = estimator ? `objective of ${estimator}` : "objective";
    const markers = { mode: "lines+markers", marker: { size: 5 }, hovertemplate: "%{y:.1f} nats" };
    const traces = curves.map(({ attempt, x, y }, index) => line([...x], [...y], curves.length > 1 ? `attempt ${attempt}` : name, index, markers));
    const layout = {
      x: "iteration",
      y: `${name}, nats`,
      height: 300,
      showlegend: curves.length > 1,
      xaxis: { rangemode: "tozero", tickformat: "d", nticks: 12 },
      yaxis: { tickformat: ".1f" },
    };
    const last = curves.at(-1);
    const label = `${name.replace("o", "O")} against iteration: ${last.y.at(-1).toFixed(1)} nats at iteration ${last.x.at(-1)}, ${last.y[0].toFixed(1)} at iteration ${last.x[0]}`;
    if (this.#drawn) {
      this.#place.setAttribute("aria-label", label);
      await this.#drawn.react(traces, layout);
    } else {
      this.#drawn = await plot(this.#place, traces, layout, { label, signal: this.#signal });
    }
  }
}

function curvesOf(id) {
  if (!seen.has(id)) {
    if (seen.size >= MAX_JOBS) seen.delete(seen.keys().next().value);
    seen.set(id, new Map());
  }
  return seen.get(id);
}
