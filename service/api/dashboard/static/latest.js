// Runs work one call at a time.

/** Return a function that runs `work` one call at a time and skips all waiting calls but the last. */
export function latest(work) {
  let busy = false, next = null;
  return async (value) => {
    next = [value];
    if (busy) return;
    busy = true;
    try {
      while (next !== null) {
        const [now] = next;
        next = null;
        await work(now);
      }
    } finally {
      busy = false;
    }
  };
}
