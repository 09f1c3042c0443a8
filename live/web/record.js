// A record.
let record = null, at = 0, playing = null;
const pictures = new Map();
async function bitmap(name) {
  if (!pictures.has(name)) {
    if (pictures.size > 24) pictures.delete(pictures.keys().next().value);
    pictures.set(name, fetch(`/frames/${name}`).then(answer => answer.ok ? answer.blob() : Promise.reject()).then(createImageBitmap).catch(() => null));
  }
  return pictures.get(name);
}
function region(k, image) {
  const ring = scene.ring_px?.[k];
  if (!ring) return [0, 0, image.width, image.height];
  const n = ring.length, wide = Math.min(image.width, 6.8 * radius(ring)), high = wide * image.height / image.width;
  const x = ring.reduce((s, p) => s + p[0], 0) / n, y = ring.reduce((s, p) => s + p[1], 0) / n;
  const left = Math.min(Math.max(0, x - wide / 2), image.width - wide), top = Math.min(Math.max(0, y - high / 2), image.height - high);
  return [left, top, left + wide, top + high];
}
async function seek(to) {
  at = Math.min(Math.max(0, to), record.moments.length - 1);
  now = record.moments[at];
  scene = record.scenes[now.scene] || scene;
  news = record.news.slice(0, now.n_news);
  contacts = record.contacts.filter(each => each[0] <= now.t);
  rows = record.rows;
  $("slider").value = at;
  $("moment").textContent = `${clock(now.t)} of ${clock(record.moments.at(-1).t)}`;
  const here = at;
  draw();
  const images = await Promise.all(now.eyes.map(name => name ? bitmap(name) : null));
  if (here !== at) return;
  images.forEach((image, k) => { if (image) Object.assign(eyes[k], {bitmap: image, whole: true, region: region(k, image), t: now.seen_s[k], number: now.eyes[k]}); });
  draw();
}
function play(on) {
  clearInterval(playing);
  playing = null;
  $("play").textContent = on ? "Pause" : "Play";
  if (!on) return;
  if (at >= record.moments.length - 1) at = 0;
  let t = record.moments[at].t, last = performance.now();
  playing = setInterval(() => {
    t += (performance.now() - last) / 1000;
    last = performance.now();
    let next = at;
    while (next < record.moments.length - 1 && record.moments[next + 1].t <= t) next++;
    if (next !== at) seek(next);
    if (at >= record.moments.length - 1) play(false);
  }, 100);
}
async function open() {
  record = await (await fetch("/run.json")).json();
  title = record.title;
  command = record.command;
  history.replaceState(null, "", "/");
  $("slider").max = Math.max(0, record.moments.length - 1);
  $("slider").addEventListener("input", () => { play(false); seek(Number($("slider").value)); });
  $("play").addEventListener("click", () => play(!playing));
  addEventListener("keydown", event => {
    if (event.target.tagName === "BUTTON" || event.target.tagName === "SUMMARY") return;
    if (event.key === " ") { event.preventDefault(); play(!playing); }
    if (event.target.type === "range" || event.target.id === "hills") return;
    if (event.key === "ArrowRight") seek(at + 1);
    if (event.key === "ArrowLeft") seek(at - 1);
  });
  if (record.moments.length) seek(0);
}
if (!live) open();

const g = $("scale").getContext("2d");
for (let x = 0; x < 92; x++) { g.fillStyle = colour(x / 91); g.fillRect(x, 0, 1, 14); }
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { tints(); draw(); });
addEventListener("resize", draw);
