// What this page has seen of a job: stages of each estimator, and the objective over the iterations. It is kept while the dashboard is open.

const seen = new Map();
const MAX_JOBS = 20;
const SEARCHES = ["geometry", "hyperparameters"];

/**
 * Add the progress of a job and return its course: {current, rows, late}.
 * rows: Map from estimator to {stages, curves}; curves: Map from stage to {x, y}: iterations and objective.
 * current: {estimator, stage}; late: whether the page was opened during the job.
 */
export function observe(job) {
  const course = courseOf(job);
  const { stage, estimator: given, iteration, objective } = job.progress;
  if (stage === "done") return course;
  const estimator = given ?? (job.estimator === "auto" ? course.current.estimator : job.estimator);
  if (given === null && job.estimator === "auto" && SEARCHES.includes(stage)) return { ...course, current: { estimator: null, stage: "loading" } };
  course.current = { estimator, stage };
  if (estimator === null || ["waiting", "loading"].includes(stage)) return course;
  if (!course.rows.has(estimator)) course.rows.set(estimator, { stages: new Set(), curves: new Map() });
  const row = course.rows.get(estimator);
  row.stages.add(stage);
  // the objective of another stage is of other samples, and that of “posterior” is the last one of the search
  if (!SEARCHES.includes(stage) || !iteration || objective === null) return course;
  const last = row.curves.get(stage);
  const repeated = last && iteration < last.x.at(-1); // the search began again
  if (!last || repeated) row.curves.set(stage, { x: [iteration], y: [objective] });
  else if (iteration > last.x.at(-1)) {
    last.x.push(iteration);
    last.y.push(objective);
  }
  return course;
}

function courseOf({ id, attempts, progress }) {
  const known = seen.get(id);
  if (known?.attempts === attempts) return known;
  if (!known && seen.size >= MAX_JOBS) seen.delete(seen.keys().next().value);
  const late = !known && (progress.iteration > 0 || !["waiting", "loading", ...SEARCHES].includes(progress.stage));
  seen.set(id, { attempts, current: { estimator: null, stage: "waiting" }, rows: new Map(), late });
  return seen.get(id);
}
