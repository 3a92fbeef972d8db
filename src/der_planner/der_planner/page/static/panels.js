// What nodes say of themselves, what planner and recorder do, the supply, and feedback's estimate.
"use strict";
(() => {
  const RECENT = 1.3; // s: nodes speak once a second
  const { find, put } = page;

  page.onShow.push((data, waited, lost) => {
    showNodes(data.nodes, waited);
    showWork(data, lost);
    const missing = data.missing.length ? `Not heard yet; to start it: ${data.missing.join(" · ")}` : "";
    put(find("missing-line"), missing);
    if (data.driver) showSupply(data.driver);
    showEstimate(data.estimate);
  });

  function showNodes(nodes, waited) {
    const body = find("node-rows");
    if (!body || !nodes.length) return;
    const names = nodes.map((node) => node.name).join();
    if (body.dataset.names !== names) {
      body.dataset.names = names;
      body.replaceChildren(...nodes.map((node) => {
        const row = document.createElement("tr");
        for (let cell = 0; cell < 5; cell += 1) row.insertCell();
        row.dataset.node = node.own || node.name;
        return row;
      }));
    }
    nodes.forEach((node, index) => {
      const cells = body.rows[index].cells, age = node.age + waited, cpu = node.values.cpu_percent;
      const heard = age < RECENT ? "now" : `${age.toFixed(1)} s ago`;
      // As text, never as HTML: messages come from anywhere.
      [node.name, node.state, node.message, cpu === undefined ? "" : `${cpu} %`, heard]
        .forEach((text, place) => put(cells[place], text));
      const state = `state ${node.state}`;
      if (cells[1].className !== state) cells[1].className = state;
    });
  }

  function showWork(data, lost) {
    const plan = find("plan-line");
    if (plan) { plan.hidden = !data.plan; put(plan, `Newest plan: ${data.plan}`); }
    const experiment = data.nodes.find((one) => one.own === "experiment"), told = find("experiment-line");
    if (told) { told.hidden = !experiment; put(told, `Experiment: ${experiment?.message}`); }
    find("report-link")?.toggleAttribute("hidden", !data.report);
    for (const [id, title, describe] of [["planner", "Planner", planning], ["recorder", "Recorder", recording]]) {
      const line = find(`${id}-line`), node = data.nodes.find((one) => one.own === id);
      if (!line) continue;
      const gone = !node || ["late", "dead", "ended"].includes(node.state);
      const away = node ? `${node.state}, last heard ${node.age.toFixed(1)} s ago` : "not heard";
      put(line, `${title}: ${gone ? away : describe(node.message, node.values)}`);
      line.className = gone || lost ? "gone" : node.state;
    }
  }

  function planning(message, values) {
    const busy = ["planning", "streaming"].includes(values.state);
    const done = busy ? ` ${(100 * Number(values.progress)).toFixed(0)} %` : "";
    const said = values.state === undefined || message.startsWith(values.state);
    return said ? message + done : `${values.state}${done}, ${message}`;
  }

  function recording(message, values) {
    if (values.bytes === undefined) return message;
    return `${message}, ${(Number(values.bytes) / 1e6).toFixed(1)} MB, ${values.recorded} messages`;
  }

  function showSupply(driver) {
    const supply = driver.supply_kpa === null ? "unknown" : `${driver.supply_kpa.toFixed(1)} kPa`;
    const heard = driver.telemetry_age === null ? "never" : `${driver.telemetry_age.toFixed(2)} s ago`;
    put(find("supply"), `Supply ${supply} absolute · board heard ${heard}`);
  }

  // What feedback knows beside the shape is shown only while it speaks.
  function showEstimate(estimate) {
    const line = find("estimate-line");
    if (!line) return;
    line.hidden = !estimate || page.isOld("estimate");
    if (line.hidden) return;
    const list = (values) => values.map((value) => (value === null ? "?" : value.toFixed(1))).join(" / ");
    put(line, `Feedback: missing pressure ${list(estimate.missing_kpa)} ± ${list(estimate.missing_sigma_kpa)} kPa, `
      + `gain error ${list(estimate.gain_error_percent)} %, correction ${list(estimate.correction_kpa)} kPa, `
      + `${estimate.share_percent} % of it acts${estimate.reason ? `: ${estimate.reason}` : ""}`);
  }
})();
