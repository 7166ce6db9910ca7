// The histogram of a picture, and where it is clipped.

const BRIGHT = 254;
const DARK = 1;

/** Counts by channel, shares of clipped pixels, and a canvas that marks them. */
export function analyse(bitmap, longest = 640) {
  const scale = Math.min(1, longest / Math.max(bitmap.width, bitmap.height));
  const [width, height] = [Math.max(1, Math.round(bitmap.width * scale)), Math.max(1, Math.round(bitmap.height * scale))];
  const canvas = new OffscreenCanvas(width, height);
  const ctx = canvas.getContext('2d', { willReadFrequently: true });
  ctx.drawImage(bitmap, 0, 0, width, height);
  const image = ctx.getImageData(0, 0, width, height);
  const counts = [new Uint32Array(256), new Uint32Array(256), new Uint32Array(256)];
  const { data } = image;
  let [bright, dark] = [0, 0];
  for (let i = 0; i < data.length; i += 4) {
    const [r, g, b] = [data[i], data[i + 1], data[i + 2]];
    counts[0][r] += 1;
    counts[1][g] += 1;
    counts[2][b] += 1;
    const isBright = r >= BRIGHT && g >= BRIGHT && b >= BRIGHT;
    const isDark = r <= DARK && g <= DARK && b <= DARK;
    bright += isBright;
    dark += isDark;
    data.set(isBright ? [255, 40, 40, 255] : isDark ? [50, 90, 255, 255] : [0, 0, 0, 0], i);
  }
  ctx.putImageData(image, 0, 0);
  const pixels = width * height;
  return { counts, bright: bright / pixels, dark: dark / pixels, clipped: canvas };
}

export function drawHistogram(canvas, { counts }) {
  const ctx = canvas.getContext('2d');
  const { width, height } = canvas;
  ctx.clearRect(0, 0, width, height);
  ctx.globalCompositeOperation = 'source-over';
  // The ends are left out of the height: a clipped picture would flatten the rest.
  const most = Math.max(1, ...counts.map((channel) => channel.subarray(2, 254).reduce((a, b) => Math.max(a, b), 0)));
  ctx.globalCompositeOperation = 'lighter';
  ['rgb(150 44 44)', 'rgb(44 128 60)', 'rgb(52 78 170)'].forEach((color, c) => {
    ctx.beginPath();
    ctx.moveTo(0, height);
    for (let i = 0; i < 256; i += 1) ctx.lineTo((i / 255) * width, height - Math.min(1, Math.sqrt(counts[c][i] / most)) * height);
    ctx.lineTo(width, height);
    ctx.fillStyle = color;
    ctx.fill();
  });
}
