// Keeps the page honest: shows what the server sends ten times a second, greys what is old, also when
// nothing comes any more, and sends the vent. It needs nothing of the page's framework.
"use strict";
// at: when the newest data were true at the latest; pictureAt: the same of the picture that is shown.
const page = { data: null, at: -Infinity, pictureAt: -Infinity, received: 0, listeners: [] };
(() => {
  const LOST = 0.7; // seconds without live data after which the connection counts as lost
  const RECENT = 1.3; // seconds: nodes speak once a second
  const seconds = () => performance.now() / 1000;
  const find = (id) => document.getElementById(id);
  const put = (element, text) => { if (element && element.textContent !== text) element.textContent = text; };
  const PRESS = 1; // seconds after a press on vent during which the click that ends it is no second one
  let socket = null, lastOpened = -Infinity, ventText = null, ventUntil = 0, ventGood = false, heard = -Infinity, pressed = -Infinity;
  let lag = Date.now() / 1000 - seconds();
  document.documentElement.lang = "en"; // for screen readers

  function connect() {
    lastOpened = seconds();
    const mine = new WebSocket(location.origin.replace(/^http/, "ws") + "/live");
    socket = mine;
    // The server answers each request once: a slow connection delays data and does not pile them up.
    const ask = () => mine.send(String(seconds()));
    mine.onopen = ask;
    mine.onmessage = (event) => {
      if (socket !== mine) return;
      page.data = JSON.parse(event.data);
      heard = seconds();
      page.at = page.data.asked + page.data.waited; // what has passed since may have been the way here
      ask();
      page.received += 1;
      show();
      page.listeners.forEach((listener) => listener(page.data));
    };
    mine.onclose = () => { if (socket === mine) socket = null; };
  }

  // The age of a source: what the server said, and the time since it said so.
  function ageOf(source) {
    const entry = page.data && page.data.sources[source];
    return entry && entry.age !== null ? entry.age + seconds() - page.at : null;
  }

  // The picture has a way of its own: it may be older than what the camera last sent.
  function pictureAge() {
    const age = ageOf("camera");
    return age === null ? null : Math.max(age, seconds() - page.pictureAt);
  }

  function show() {
    const silence = seconds() - page.at, lost = silence > LOST;
    document.body.classList.toggle("lost", lost);
    const notice = find("notice");
    if (notice) {
      const venting = seconds() < ventUntil;
      notice.classList.toggle("shown", lost || venting);
      notice.classList.toggle("good", venting && ventGood && !lost);
      const slow = seconds() - heard <= LOST;
      const away = slow ? `The connection is slow: what is shown below was so ${silence.toFixed(1)} s ago.` : Number.isFinite(silence) ? `No connection to the page's server for ${silence.toFixed(1)} s: nothing below is live.`
        : "Waiting for the page's server…";
      put(notice, [venting ? ventText : "", lost ? away : ""].filter(Boolean).join("  "));
    }
    for (const panel of document.querySelectorAll("#panels > section")) showAge(panel, lost, silence);
    const driver = page.data && page.data.driver, age = ageOf("driver");
    const old = lost || age === null || age > page.data.sources.driver.limit;
    put(find("mode"), driver && age !== null ? driver.mode : "no driver");
    put(find("faults"), driver && age !== null ? (old ? `${age.toFixed(1)} s ago  ` : "") + driver.faults.join("; ") : "");
    find("mode")?.classList.toggle("fault", !!driver && driver.mode === "fault");
    find("summary")?.classList.toggle("old", old);
    if (page.data) { showNodes(page.data.nodes, seconds() - page.at); showSupply(driver); showLines(page.data, lost); showEstimate(page.data.estimate); }
  }

  function showAge(panel, lost, silence) {
    const source = panel.dataset.source, entry = source && page.data && page.data.sources[source];
    let old = lost, text = lost && Number.isFinite(silence) ? `${silence.toFixed(1)} s old` : "";
    if (source) {
      const age = panel.id === "view" ? pictureAge() : ageOf(source);
      old = old || age === null || age > entry.limit;
      text = age === null ? "nothing received" : age === Infinity ? "no picture yet" : old ? `${age.toFixed(1)} s old` : "live";
    }
    panel.classList.toggle("old-title", old);
    for (const child of panel.children) if (child.querySelector && !child.querySelector("h2")) child.classList.toggle("old", old && panel.id !== "do");
    put(panel.querySelector(".age"), text);
  }

  // Only what changed is written, since the browser lays out and paints the table anew with it.
  function showNodes(nodes, waited) {
    const body = find("node-rows");
    if (!body || !nodes.length) return;
    const names = nodes.map((node) => node.name).join();
    if (body.dataset.names !== names) {
      body.dataset.names = names;
      body.replaceChildren(...nodes.map((node) => {
        const row = document.createElement("tr");
        for (let cell = 0; cell < 5; cell += 1) row.insertCell();
        row.dataset.node = node.name;
        return row;
      }));
    }
    nodes.forEach((node, index) => {
      const cells = body.rows[index].cells, age = node.age + waited;
      // As text, never as HTML: messages come from anywhere.
      [node.name, node.state, node.message, cpuOf(node), age < RECENT ? "now" : `${age.toFixed(1)} s ago`]
        .forEach((text, place) => put(cells[place], text));
      if (cells[1].className !== `state ${node.state}`) cells[1].className = `state ${node.state}`;
    });
  }

  const cpuOf = (node) => (node.values.cpu_percent === undefined ? "" : `${node.values.cpu_percent} %`);

  // What planner and recorder do now, beside the buttons that command them.
  function showLines(data, lost) {
    const nodes = data.nodes, plan = find("plan-line");
    if (plan) { plan.hidden = !data.plan; put(plan, `Newest plan: ${data.plan}`); }
    for (const name of ["planner", "recorder"]) {
      const line = find(`${name}-line`), node = nodes.find((one) => one.name === name);
      if (!line) continue;
      const away = !node ? "not heard" : ["late", "dead"].includes(node.state) ? `${node.state}, last heard ${node.age.toFixed(1)} s ago` : "";
      put(line, `${name[0].toUpperCase()}${name.slice(1)}: ${away || describe(name, node)}`);
      line.className = !node || away || lost ? "gone" : node.state;
    }
  }

  function describe(name, node) {
    const values = node.values, megabytes = Number(values.bytes) / 1e6;
    if (name === "recorder") return node.message + (values.bytes === undefined ? "" : `, ${megabytes.toFixed(1)} MB, ${values.messages} messages`);
    const done = ["planning", "streaming"].includes(values.state) ? ` ${(100 * Number(values.progress)).toFixed(0)} %` : "";
    return values.state === undefined || node.message.startsWith(values.state) ? node.message + done : `${values.state}${done}, ${node.message}`;
  }

  // What feedback knows beside the shape: shown only while it speaks.
  function showEstimate(estimate) {
    const line = find("estimate-line"), age = ageOf("estimate");
    if (!line) return;
    line.hidden = !estimate || age === null || age > page.data.sources.estimate.limit;
    if (line.hidden) return;
    const list = (values) => values.map((value) => (value === null ? "?" : value.toFixed(1))).join(" / ");
    put(line, `Feedback: missing pressure ${list(estimate.missing_kpa)} ± ${list(estimate.missing_sigma_kpa)} kPa, gain error ` +
      `${list(estimate.gain_error_percent)} %, correction ${list(estimate.correction_kpa)} kPa, ${estimate.share_percent} % of it acts` +
      (estimate.reason ? `: ${estimate.reason}` : ""));
  }

  function showSupply(driver) {
    if (!driver) return;
    const supply = driver.supply_kpa === null ? "unknown" : `${driver.supply_kpa.toFixed(1)} kPa`;
    put(find("supply"), `Supply ${supply} absolute · board heard ${driver.telemetry_age === null ? "never" : driver.telemetry_age.toFixed(2) + " s ago"}`);
  }

  // While a computer sleeps, the steady clock may stand still: what the calendar is ahead by counts as age, too.
  function watchSleep() {
    const now = Date.now() / 1000 - seconds(), slept = now - lag;
    lag = now;
    if (slept < LOST) return;
    page.at -= slept;
    page.pictureAt -= slept;
    heard -= slept;
  }

  async function vent() {
    const button = find("vent");
    button?.classList.add("sent");
    try {
      const answer = await fetch("/vent", { method: "POST", signal: AbortSignal.timeout(4000) });
      const result = answer.ok ? await answer.json() : { success: false, message: await answer.text() };
      ventGood = result.success;
      ventText = result.success ? `Vented: ${result.message}` : `VENT FAILED: ${result.message}`;
    } catch (error) {
      ventGood = false;
      ventText = `VENT FAILED: the page's server does not answer (${error.message}). Close the supply by hand.`;
    }
    ventUntil = seconds() + (ventGood ? 4 : 30);
    button?.classList.remove("sent");
    show();
  }

  const typing = (element) => element && (element.isContentEditable || element.tagName === "TEXTAREA" ||
    (element.tagName === "INPUT" && ["text", "search", "password"].includes(element.type) && !["decimal", "numeric"].includes(element.inputMode) && !element.readOnly));
  const onVent = (event) => event.target.closest?.("#vent");
  document.addEventListener("pointerdown", (event) => { if (onVent(event)) { event.preventDefault(); pressed = seconds(); vent(); } }, true);
  // The Enter key, screen readers and switches click without a pointer.
  document.addEventListener("click", (event) => { if (onVent(event) && (event.detail === 0 || seconds() - pressed > PRESS)) vent(); }, true);
  const sayKey = () => put(document.querySelector("#vent small"), typing(document.activeElement) ? "press here: typing" : "space bar");
  for (const kind of ["focusin", "focusout"]) document.addEventListener(kind, () => setTimeout(sayKey));
  // Before any other key handler, so that a space bar vents even where a button has the focus.
  for (const kind of ["keydown", "keyup"]) window.addEventListener(kind, (event) => {
    if (event.code !== "Space" || typing(event.target)) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (kind === "keydown" && !event.repeat) vent();
  }, true);

  setInterval(() => {
    // A connection that says nothing is given up, since a dead server's may stay open for minutes.
    if (socket && seconds() - heard > 3 && seconds() - lastOpened > 3) { socket.close(); socket = null; }
    if (!socket && seconds() - lastOpened > 1) connect();
    watchSleep();
    show();
  }, 200);
  document.addEventListener("visibilitychange", show);
  connect();
})();
