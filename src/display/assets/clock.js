// One clock for everything that moves: at most 20 pictures a second, and all in the same picture.

/** Least time between two pictures, ms; on a screen of 60 pictures a second every third one then. */
const EVERY = 42;

let due = new Set();
let scheduled = false;
let last = 0;

/** Calls `work` once before the next picture; none comes while the page is hidden. */
export function next(work) {
  due.add(work);
  if (scheduled) return;
  scheduled = true;
  setTimeout(() => requestAnimationFrame(run), Math.max(0, last + EVERY - performance.now()));
}

function run(now) {
  scheduled = false;
  last = performance.now();
  const works = due;
  due = new Set();
  for (const work of works) work(now);
}
