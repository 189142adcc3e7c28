// One clock for everything that moves: at most 20 frames a second, with all changes in the same frame.

/** Minimum time between two frames, ms. A screen with 60 frames a second shows every third one. */
const EVERY = 42;

let due = new Set();
let scheduled = false;
let last = 0;

/** Calls `work` once before the next frame; there are no frames while the page is hidden. */
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
