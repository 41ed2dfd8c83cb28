// Ranges of rows in addresses, and places in ascending lists.

/** Parse rows [first, last) from text such as 300-450; null if it is invalid. */
export function rowsOf(text) {
  const found = /^(\d+)-(\d+)$/.exec(text ?? "");
  const rows = found && [Number(found[1]), Number(found[2])];
  return rows && rows[0] < rows[1] ? rows : null;
}

/** Return the index of the number nearest to x in an ascending list. */
export function nearest(rising, x) {
  let [low, high] = [0, rising.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (rising[middle] <= x) low = middle;
    else high = middle;
  }
  return x - rising[low] <= rising[high] - x ? low : high;
}
