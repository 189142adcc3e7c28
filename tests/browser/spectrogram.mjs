// The pixels of a spectrogram.

/** Waits until what the server has in detail of the view is drawn; gives what it covers. */
export async function refined(page) {
  await page.waitForFunction(() => document.getElementById("spectrogram").refined());
  await settled(page);
  return page.evaluate(() => document.getElementById("spectrogram").refined());
}

/** Waits until the view is drawn, of a channel if one is named. */
export const settled = (page, channel) => page.waitForFunction((channel) => {
  const canvas = document.getElementById("spectrogram");
  const [view, painted] = [canvas.view?.(), canvas.painted?.()];
  return view && painted && ["from", "to", "low", "high"].every((side) => view[side] === painted[side]) && (!channel || painted.channel === channel);
}, channel);

/**
 * The column of pixels at a time, near a frequency. `light`: largest lightness within 6 px of it, without the overlay;
 * `lightest`: how far that pixel is from it, px; `median`: lightness of the column; `off`: how far the middle of the nearest
 * predicted line is from it, px.
 */
export const column = (page, seconds, hz) => page.evaluate(([seconds, hz]) => {
  const canvas = document.getElementById("spectrogram");
  const ratio = canvas.width / canvas.clientWidth;
  const [x, y] = canvas.position(seconds, hz).map((px) => px * ratio);
  const copy = new OffscreenCanvas(1, canvas.height).getContext("2d", { willReadFrequently: true });
  copy.drawImage(canvas, -Math.floor(x), 0);
  const column = copy.getImageData(0, 0, 1, canvas.height).data;
  const pixels = Array.from({ length: canvas.height }, (_, k) => {
    const [r, g, b] = column.slice(4 * k, 4 * k + 3);
    const line = b > r + 60 && g > r + 60;
    return { away: (k + 0.5 - y) / ratio, line, light: line ? 0 : 0.21 * r + 0.72 * g + 0.07 * b };
  });
  const lines = [];
  for (const [k, { line, away }] of pixels.entries()) {
    if (line && pixels[k - 1]?.line) lines[lines.length - 1].push(away);
    else if (line) lines.push([away]);
  }
  const off = lines.map((line) => Math.abs((line[0] + line[line.length - 1]) / 2));
  const near = pixels.filter(({ away }) => Math.abs(away) <= 6).sort((a, b) => b.light - a.light)[0];
  const sorted = pixels.map(({ light }) => light).sort((a, b) => a - b);
  return { light: near.light, lightest: Math.abs(near.away), median: sorted[sorted.length >> 1], off: Math.min(...off) };
}, [seconds, hz]);

/** The predicted frequency nearest to one at a time, and the middle of the time for which it is drawn. */
export function predicted(history, seconds, hz) {
  const bin = history.bins.findLast((bin) => bin.k * history.bin_s <= seconds);
  const near = bin.u.map(([hz]) => hz).sort((a, b) => Math.abs(a - hz) - Math.abs(b - hz))[0];
  return { hz: near, seconds: (bin.k + 0.5) * history.bin_s };
}
