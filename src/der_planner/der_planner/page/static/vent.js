// The vent button and the space bar. They need neither the page's framework nor the other scripts;
// where no script runs at all, the button still sends its form.
"use strict";
(() => {
  const PRESS = 1000; // ms after a press during which the click that ends it is no second press
  const CONFIRMED = 700; // ms after the press from which a vent that nobody has confirmed is said to be none
  const find = (id) => document.getElementById(id);
  const button = find("vent"), notice = find("vent-notice");
  let pressed = -Infinity, hiding = 0;

  async function vent(press) {
    let good = false, text;
    button.classList.add("sent");
    // Whoever waits for an answer must not wait longer than the limb may.
    const late = setTimeout(() => tell("VENT NOT CONFIRMED yet: close the valve at the air supply now.", false),
      press.timeStamp + CONFIRMED - performance.now());
    try {
      const answer = await fetch("/vent", { method: "POST", signal: AbortSignal.timeout(4000) });
      const result = answer.ok ? await answer.json() : { message: `NOT VENTED; close the valve at the air supply: ${await answer.text()}` };
      good = result.success === true;
      text = `${good ? "Vented" : "VENT FAILED"}: ${result.message}`;
    } catch (error) {
      text = `VENT FAILED: the page's server does not answer (${error.message}). Close the valve at the air supply.`;
    }
    clearTimeout(late);
    button.classList.remove("sent");
    tell(text, good);
  }

  function tell(text, good) {
    notice.textContent = text;
    notice.className = good ? "good" : "danger";
    notice.hidden = false;
    clearTimeout(hiding);
    hiding = setTimeout(() => { notice.hidden = true; }, good ? 4000 : 30000);
  }

  // When the button is pressed, not when it is let go.
  button.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    pressed = performance.now();
    vent(event);
  });
  // The Enter key, screen readers and switches click without a pointer.
  button.addEventListener("click", (event) => {
    event.preventDefault();
    if (event.detail === 0 || performance.now() - pressed > PRESS) vent(event);
  });

  // Whether a space belongs to a text that is being written; no number has one.
  function typing(element) {
    if (!element || element.isContentEditable || element.tagName === "TEXTAREA") return !!element;
    return element.tagName === "INPUT" && ["text", "search"].includes(element.type)
      && !["decimal", "numeric"].includes(element.inputMode) && !element.readOnly;
  }

  // Before any other key handler, so that a space bar vents even where a button has the focus.
  for (const kind of ["keydown", "keyup"]) {
    window.addEventListener(kind, (event) => {
      if (event.code !== "Space" || typing(event.target)) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      if (kind === "keydown" && !event.repeat) vent(event);
    }, true);
  }
  const sayKey = () => {
    find("vent-key").textContent = typing(document.activeElement) ? "press here: typing" : "space bar";
  };
  for (const kind of ["focusin", "focusout"]) document.addEventListener(kind, () => setTimeout(sayKey));
})();
