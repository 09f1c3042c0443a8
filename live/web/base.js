"use strict";
const $ = id => document.getElementById(id);
const live = document.body.dataset.mode === "live";
const SVG = "http://www.w3.org/2000/svg";
const CIVIDIS = [[0, 32, 77], [0, 52, 110], [61, 78, 107], [102, 105, 112], [124, 123, 120], [155, 147, 118], [189, 173, 108], [224, 201, 88], [255, 234, 70]];
let scene = {ring_px: null, marks_px: [{}, {}], limit_mm: null, n: 0, surface: null, path_mm: null, setpoints: [], fit: null, checks: []};
let now = null, news = [], rows = [], contacts = [], title = "", command = "";
const eyes = [{}, {}];

// Colours that also those tell apart who see no red or green; what is unknown is hatched and never coloured.
function colour(share) {
  const x = Math.min(Math.max(share, 0), 1) * (CIVIDIS.length - 1), k = Math.min(Math.floor(x), CIVIDIS.length - 2);
  return `rgb(${CIVIDIS[k].map((low, i) => Math.round(low + (x - k) * (CIVIDIS[k + 1][i] - low))).join()})`;
}
// Looked up once: asking for a style between two changes of the page makes it lay itself out anew, and a stop would wait.
let palette = {};
function tints() {
  const all = getComputedStyle(document.documentElement);
  palette = Object.fromEntries(["--card", "--ink", "--soft", "--line", "--grid", "--blue", "--orange", "--green", "--red", "--unknown"].map(name => [name, all.getPropertyValue(name).trim()]));
}
tints();
const style = name => palette[name];
const before = {};
function changed(part, ...what) {
  const key = JSON.stringify(what);
  if (before[part] === key) return false;
  before[part] = key;
  return true;
}
const clock = s => `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, "0")}`;
const known = value => value !== null && value !== undefined;
const um = mm => `${Math.round(1000 * mm)}`;

// How a point stands: one of done, stopped, yes, no, unasked; and why.
function standing(i) {
  const p = now.points, state = p.state?.[i];
  if (state === "done") return ["done", p.why[i] || "finished"];
  if (state === "stopped") return ["stopped", p.why[i] || p.permission[i] || "stopped until the next look"];
  const said = p.permission?.[i];
  return !known(said) ? ["unasked", p.contact?.[i] ? "not asked yet" : "no contact yet"] : said === "" ? ["yes", "there is bone"] : ["no", said];
}

// A command that cuts nothing, or what comes before the cutting.
const inTheAir = () => command === "calibrate" || command === "doctor" || (scene.n === 0 && scene.setpoints.length > 0);

function draw() {
  if (!now) return;
  document.body.classList.toggle("air", inTheAir());
  document.body.classList.toggle("doctor", command === "doctor");
  const over = now.outcome;
  $("stage").textContent = over ? over.outcome : {mill: "milling"}[now.stage] || now.stage;
  $("stage").textContent = $("stage").textContent.replace(/^./, c => c.toUpperCase()) + (now.state === "paused" && !over ? " – paused" : "");
  $("detail").textContent = [now.lap && now.stage === "mill" && !over ? `lap ${now.lap.toFixed(1)}` : "", over ? over.reason : now.detail, inTheAir() ? "" : `spindle ${now.spindle}`].filter(Boolean).join(" · ");
  $("time").textContent = clock(now.t);
  document.title = `${$("stage").textContent} – ${title || "mill"}`;
  banner();
  if (inTheAir()) {
    setpoints();
    checks();
  } else {
    gauge();
    reasons();
    table();
    curves();
    surface();
  }
  happenings();
  eyes.forEach((_, k) => picture(k));
}

function banner() {
  const fault = news.filter(each => each.kind === "latched" || each.kind === "error")[0], box = $("banner");
  let text = "", good = false;
  if (live && !socketOpen) text = "⚠ No connection. This page cannot stop the machine: use its emergency stop, or mill stop.";
  else if (now.cut_off) text = "⚠ mill has ended without a word. Look at the machine; the supervisor stops the motion of a dead run.";
  else if (now.outcome) { good = now.outcome.outcome === "complete"; text = `${good ? "✓" : "⚠"} ${now.outcome.outcome}: ${now.outcome.reason}`; }
  else if (fault) text = `⚠ ${fault.what}: ${fault.why}`;
  else if (live && now.stage === "mill" && now.silent_s > 1) text = `⚠ mill has been silent for ${now.silent_s.toFixed(0)} s`;
  if (box.textContent !== text) box.textContent = text;
  box.className = text ? `shown ${good ? "good" : "bad"}` : "";
  $("heard").textContent = !live ? title : now.ended ? "ended" : now.silent_s > 0.9 ? `last word ${now.silent_s.toFixed(0)} s ago` : "live";
}

