// Keeps the page honest: asks the server for data ten times a second, and greys what is old, also
// when nothing comes any more. It needs nothing of the page's framework.
"use strict";
const page = {
  data: null, // the newest data
  at: -Infinity, // s of this window's clock at which they were true at the latest
  pictureAt: -Infinity, // the same of the picture that is shown
  received: 0,
  onData: [], // called with new data
  onShow: [], // called with the data, how long ago they were true [s], and whether the server is lost
  onState: [], // called always: how long ago the data were true, whether the server is lost, its silence [s]
  find: (id) => document.getElementById(id),
  seconds: () => performance.now() / 1000,
  // Writes only what changed, since the browser lays out and paints an element anew with it.
  put: (element, text) => { if (element && element.textContent !== text) element.textContent = text; },
  // The age of a source [s]: what the server said, and the time since it said so; null: never heard.
  ageOf: (source) => {
    const entry = page.data?.sources[source];
    return !entry || entry.age === null ? null : entry.age + page.seconds() - page.at;
  },
  isOld: (source) => {
    const age = page.ageOf(source);
    return age === null || age > page.data.sources[source].limit;
  },
};
(() => {
  const LOST = 0.7; // s without live data after which the connection counts as lost
  const { put, seconds } = page;
  // Of this tab, also after it has been loaded anew: the desk is its.
  const tab = sessionStorage.limbTab ||= Math.random().toString(36).slice(2) + Date.now().toString(36);
  let socket = null, opened = -Infinity, heard = -Infinity;
  let ahead = Date.now() / 1000 - seconds();
  document.documentElement.lang = "en"; // for screen readers

  function connect() {
    opened = seconds();
    const mine = new WebSocket(location.origin.replace(/^http/, "ws") + "/live");
    socket = mine;
    // The server answers each request once: a slow connection delays data and does not pile them up.
    const ask = () => mine.send(`${seconds()} ${window.limbWindow} ${tab}`);
    mine.onopen = ask;
    mine.onmessage = (event) => {
      if (socket !== mine) return;
      page.data = JSON.parse(event.data);
      heard = seconds();
      page.at = page.data.asked + page.data.waited; // what has passed since may have been the way here
      page.received += 1;
      ask();
      show();
      page.onData.forEach((listener) => listener(page.data));
    };
    mine.onclose = () => { if (socket === mine) socket = null; };
  }

  function show() {
    const silence = seconds() - page.at, lost = silence > LOST;
    document.body.classList.toggle("lost", lost);
    for (const panel of document.querySelectorAll("#panels > section")) showAge(panel, silence, lost);
    page.onState.forEach((listener) => listener(silence, lost, seconds() - heard));
    if (page.data) page.onShow.forEach((listener) => listener(page.data, silence, lost));
  }

  function showAge(panel, silence, lost) {
    const source = panel.dataset.source;
    let old = lost, text = lost && Number.isFinite(silence) ? `${silence.toFixed(1)} s old` : "";
    if (source) {
      let age = page.ageOf(source);
      // The picture has a way of its own: it may be older than what the camera last sent.
      if (panel.id === "view" && age !== null) age = Math.max(age, seconds() - page.pictureAt);
      old = lost || age === null || age > page.data.sources[source].limit;
      text = old ? `${age?.toFixed(1)} s old` : "live";
      if (age === null) text = "nothing received";
      if (age === Infinity) text = "no picture yet";
    }
    panel.classList.toggle("old-title", old);
    for (const child of panel.children) {
      if (!child.querySelector("h2")) child.classList.toggle("old", old && panel.id !== "do");
    }
    put(panel.querySelector(".age"), text);
  }

  // While a computer sleeps, the steady clock may stand still: the calendar's lead counts as age, too.
  function watchSleep() {
    const now = Date.now() / 1000 - seconds(), slept = now - ahead;
    ahead = now;
    if (slept < LOST) return;
    page.at -= slept;
    page.pictureAt -= slept;
    heard -= slept;
  }

  // The panels' framework would load the window anew whenever it cannot connect for a while, and state and
  // vent would be away for as long. It connects again by itself; where the server does not know the panels
  // any more, they are loaded anew once live data have come for a while.
  const AGAIN = 3000; // ms
  let unknown = false, alive = 0;
  const hold = setInterval(() => {
    if (!window.socket) return;
    clearInterval(hold);
    window.socket.off("connect_error");
    window.socket.on("connect_error", (error) => { unknown = error.message.startsWith("Implicit"); });
    window.socket.on("connect", () => { unknown = false; });
  }, 50);
  setInterval(() => {
    alive = seconds() - page.at > LOST ? 0 : alive + 200;
    if (unknown && alive >= AGAIN) location.reload();
  }, 200);

  setInterval(() => {
    // A connection that says nothing is given up, since a dead server's may stay open for minutes.
    // The first answer needs several ways there and back.
    const patience = heard > opened ? 3 : 10;
    if (socket && seconds() - Math.max(heard, opened) > patience) { socket.close(); socket = null; }
    if (!socket && seconds() - opened > 1) connect();
    watchSleep();
    show();
  }, 200);
  document.addEventListener("visibilitychange", show);
  connect();
})();
