// A run that goes on.
let socket = null, socketOpen = false, ended = false, drawn = false;
function later() { if (!drawn) { drawn = true; requestAnimationFrame(() => { drawn = false; draw(); }); } }
function watch() {
  socket = new WebSocket(`ws://${location.host}/watch`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { socketOpen = true; };
  socket.onmessage = async message => {
    if (message.data instanceof ArrayBuffer) {
      const view = new DataView(message.data), k = view.getUint8(0), eye = eyes[k];
      const region = [9, 11, 13, 15].map(at => view.getUint16(at, true)), t = view.getFloat64(1, true);
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(message.data, 17)], {type: "image/jpeg"}));
      eye.bitmap?.close();
      Object.assign(eye, {bitmap, region, t, number: (eye.number || 0) + 1});
    } else {
      const told = JSON.parse(message.data);
      if (told.kind === "history") { rows = told.rows; title = told.title; command = told.command; }
      else if (told.kind === "scene") scene = told;
      else { now = told; news = told.news; contacts = told.contacts; rows.push(told.row); if (rows.length > 2400) rows = rows.filter((_, i) => i % 2 === 0); ended = told.ended; button(); }
    }
    later();
  };
  socket.onclose = () => { socketOpen = ended; button(); later(); if (!ended) setTimeout(watch, 500); };
}
function button() {
  const possible = socketOpen && now?.can_stop && !ended;
  $("stop").disabled = !possible;
  $("stop-how").textContent = possible ? (news.some(each => each.kind === "person") ? "told – press again to repeat" : "Esc or Space") : ended ? "the run has ended" : socketOpen ? "nothing to stop yet" : "no connection";
}
function stop() { if (socket?.readyState === WebSocket.OPEN) socket.send("stop"); }
if (live) {
  // On the way down, not at its end: nothing else may be meant by this button.
  $("stop").addEventListener("pointerdown", stop);
  addEventListener("keydown", event => {
    const summary = event.target.tagName === "SUMMARY";
    if (event.key === "Escape" || (event.key === " " && !summary) || (event.key === "Enter" && event.target === $("stop"))) { event.preventDefault(); if (!event.repeat) stop(); }
  }, true);
  history.replaceState(null, "", "/");
  watch();
}

