// Plots of the objective of one estimator: one for each search, with an axis of its own.

import { ErrorBox } from "../../components.js";
import { Export } from "../../exporting.js";
import { line, plot } from "../../plots.js";
import { html, useEffect, useRef, useState } from "../../preact.js";

const NAMES = { geometry: "Geometry", hyperparameters: "Fit" };
const TICKS = 6;

/** What the plots mean, true for each of them. */
export const OBJECTIVE_HINT = "Objective: penalised negative log evidence of the training samples. Within one plot, lower is a better fit. Plots are not comparable: their samples or models differ.";

/** The plots of an estimator. row: of `observe`; job: named in files. */
export function Objective({ estimator, row, job }) {
  const curves = [...row.curves];
  const table = () => [["estimator", "search", "iteration", "objective, nats"], ...curves.flatMap(([stage, { x, y }]) => x.map((each, index) => [estimator, NAMES[stage].toLowerCase(), each, y[index]]))];
  return curves.length > 0 && html`<div>
    <div class="grid objectives">${curves.map(([stage, curve]) => html`<${Curve} key=${stage} name=${`${NAMES[stage]} of ${estimator}`} curve=${curve} length=${curve.x.length} />`)}</div>
    <${Export} name=${`objective of ${estimator}, ${job.model}`} table=${table} />
  </div>`;
}

/** Draw a curve that grows. The plot is kept: if points arrive faster than it can be drawn, only the last state is drawn. */
function Curve({ name, curve, length }) {
  const place = useRef(null), work = useRef({ plot: null, drawing: false, next: null, stop: null }), [error, setError] = useState(null);
  useEffect(() => {
    work.current.stop = new AbortController();
    return () => work.current.stop.abort();
  }, []);
  useEffect(() => {
    draw(place.current, work.current, name, curve).then(() => setError(null), (failure) => work.current.stop.signal.aborted || setError(failure));
  }, [name, curve, length]);
  return html`<div>${error && html`<${ErrorBox} error=${error} />`}<div class="objective" ref=${place}></div></div>`;
}

async function draw(place, work, name, curve) {
  work.next = curve;
  if (work.drawing) return;
  work.drawing = true;
  try {
    while (work.next && !work.stop.signal.aborted) {
      const { x, y } = work.next;
      work.next = null;
      const label = `${name}: objective ${y.at(-1).toFixed(1)} nats at iteration ${x.at(-1)}, ${y[0].toFixed(1)} at iteration ${x[0]}`;
      const traces = [line([...x], [...y], name, "accent", { mode: "lines+markers", marker: { size: 5 }, hovertemplate: "%{y:.1f} nats<extra></extra>" })];
      const layout = {
        title: name,
        x: "iteration",
        y: "objective, nats",
        height: 230,
        showlegend: false,
        xaxis: { dtick: wholeStep(x.at(-1) - x[0]), tickformat: "d" },
        yaxis: { nticks: 5, exponentformat: "none" },
      };
      if (work.plot) {
        place.setAttribute("aria-label", label);
        await work.plot.react(traces, layout);
      } else work.plot = await plot(place, traces, layout, { label, signal: work.stop.signal });
    }
  } finally {
    work.drawing = false;
  }
}

/** Return a step between ticks of whole numbers: 1, 2, 5, 10, … so that no label repeats. */
export function wholeStep(range) {
  const least = Math.max(range / TICKS, 1);
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((each) => each * power).find((each) => each >= least);
}
