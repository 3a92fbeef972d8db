// The alarm over the whole width, and the state: what the limb does, and nothing old as if it were so.
"use strict";
(() => {
  const SLOW = 1.5; // s since the server was last heard, up to which a connection is slow and not dead
  const { find, put } = page;
  const LINE = find("alarm").firstElementChild;
  const rounded = (value) => value.toFixed(1).replace(/^-(0\.0)$/, "$1");
  const TITLE = document.title;
  const ago = (age) => `${age.toFixed(age < 10 ? 1 : 0)} s`;

  page.onState.push((silence, lost, unheard) => {
    const driver = page.ageOf("driver") === null ? null : page.data.driver;
    const old = lost || page.isOld("driver");
    const known = page.data?.alarms ?? [], slow = lost && page.data && unheard <= SLOW;
    if (slow) showAlarms([...known, ofServer(unheard, driver)], silence); // what is dead stays so
    else showAlarms(lost ? [ofServer(unheard, driver)] : known, silence);
    showState(driver, old);
  });

  // What is wrong with the page itself, which only this window can tell.
  function ofServer(unheard, driver) {
    if (!page.data) return { level: "notice", text: "Waiting for the page's server…" };
    if (unheard <= SLOW) return { level: "notice", text: "The connection is slow: what is shown below is old", since: 0 };
    const limb = driver
      ? `When last heard, the limb was ${page.data.limb_is}, in mode ${driver.mode}`
      : "Nothing is known of the limb";
    return {
      level: "danger",
      text: `No connection to the page's server: nothing below is live. ${limb}`,
      since: 0,
      advice: "VENT may not reach it from here: close the valve at the air supply; if the page was started again, open the address that it prints",
    };
  }

  function showAlarms(alarms, silence) {
    const place = find("alarm");
    while (place.children.length > alarms.length) place.lastChild.remove();
    alarms.forEach((alarm, index) => {
      const line = place.children[index] ?? place.appendChild(LINE.cloneNode(true));
      const since = alarm.since == null ? "" : ` (for ${ago(alarm.since + Math.max(silence, 0))})`;
      const advice = alarm.advice ? ` → ${alarm.advice[0].toUpperCase()}${alarm.advice.slice(1)}` : ""; // no full stop: it may end with a command
      const full = alarm.text.endsWith("…") || alarm.text.endsWith(".") ? "" : ".";
      // As text, never as HTML. The time is hidden from screen readers: they would read the alarm anew with each change.
      [alarm.text, since, `${full}${advice}`].forEach((text, part) => put(line.children[part], text));
      if (line.className !== alarm.level) line.className = alarm.level;
    });
    const title = alarms.some((alarm) => alarm.level === "danger") ? `ALARM: ${TITLE}` : TITLE; // for who has another tab before them
    if (document.title !== title) document.title = title;
    const height = `${find("notices").offsetHeight}px`; // it must cover nothing
    if (document.body.style.paddingTop !== height) document.body.style.paddingTop = height;
  }

  function showState(driver, old) {
    const known = driver && !old;
    const word = find("mode"), state = known ? driver.mode : "unknown";
    put(word, known ? driver.mode : "not known");
    if (word.className !== state) word.className = state;
    find("summary").classList.toggle("old", !known);
    let meaning = known ? driver.meaning : "no driver is heard";
    if (driver && !known) meaning = `${ago(page.ageOf("driver"))} ago: ${driver.mode}, ${page.data.limb_is}`;
    put(find("meaning"), meaning);
    put(find("figures"), known ? figures(driver) : "");
    const failed = find("vent-notice"); // of a vent that the limb has taken after all
    const vented = known && ["disarmed", "fault"].includes(driver.mode) && page.data.limb_is === "without pressure";
    if (vented && failed.className === "danger") failed.hidden = true;
  }

  // Present numbers: pressures, tip error, progress of the plan.
  function figures(driver) {
    const pressures = driver.measured_kpa.map((value) => (value === null ? "?" : rounded(value))).join(" / ");
    const error = page.isOld("tracker") ? null : page.data.limb?.error_cm ?? null;
    const planner = page.data.nodes.find((node) => node.own === "planner");
    const busy = planner && ["ok", "warning"].includes(planner.state)
      && ["planning", "streaming"].includes(planner.values.state);
    return [
      `${pressures} kPa`,
      error === null ? "" : `tip error ${error.toFixed(2)} cm`,
      busy ? `${planner.values.state} ${(100 * Number(planner.values.progress)).toFixed(0)} %` : "",
    ].filter(Boolean).join(" · ");
  }
})();
