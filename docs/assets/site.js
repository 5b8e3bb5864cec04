// The rules of nuPlan as a table with a filter. The page itself holds headings and lists, which is
// what a reader without JavaScript sees.

function make(tag, properties, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

function titleOf(heading) {
  const copy = heading.cloneNode(true);
  copy.querySelector(".headerlink")?.remove();
  return copy;
}

function ruleRow(heading, list) {
  const title = titleOf(heading);
  const number = title.textContent.match(/^\d+/)[0];
  title.firstChild.data = title.firstChild.data.replace(/^\d+\. /, "");
  const summary = make("summary", {}, ...title.childNodes);
  const link = make("a", { href: `#${heading.id}`, textContent: number });
  for (const code of list.querySelectorAll("code")) // paths break at their slashes
    code.replaceChildren(...code.textContent.split(/(?<=\/)/).flatMap((part) => [part, make("wbr", {})]));
  const rule = make("td", {}, make("details", {}, summary, list));
  const where = [...list.children].find((item) => item.textContent.startsWith("Where"));
  const code = make("td", {}, where.querySelector("code")?.cloneNode(true) ?? "");
  return make("tr", { id: heading.id }, make("td", {}, link), rule, code);
}

function rulesTable(sections) {
  const bodies = [];
  for (const section of sections) {
    const cell = make("th", { colSpan: 3, textContent: titleOf(section).textContent });
    const body = make("tbody", {}, make("tr", { id: section.id }, cell));
    for (let node = section.nextElementSibling; node?.tagName === "H3"; ) {
      const [heading, list] = [node, node.nextElementSibling];
      node = list.nextElementSibling;
      body.append(ruleRow(heading, list));
      heading.remove();
    }
    bodies.push(body);
    section.remove();
  }
  return make("table", { className: "rules" }, ...bodies);
}

function filterBox(table) {
  const input = make("input", { type: "search", placeholder: "Filter, such as: progress route" });
  input.setAttribute("aria-label", "Filter the rules");
  const count = make("span", {});
  count.setAttribute("role", "status");
  const rows = [...table.querySelectorAll("tr:has(details)")];
  const texts = rows.map((row) => row.textContent.toLowerCase());
  const apply = () => {
    const words = input.value.toLowerCase().split(/\s+/);
    rows.forEach((row, i) => (row.hidden = !words.every((word) => texts[i].includes(word))));
    for (const body of table.tBodies)
      body.hidden = ![...body.rows].slice(1).some((row) => !row.hidden);
    count.textContent = `${rows.filter((row) => !row.hidden).length} of ${rows.length} rules`;
  };
  input.addEventListener("input", apply);
  apply();
  return make("div", { className: "rules-filter" }, input, count);
}

function openLinkedRule() {
  const row = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!row?.matches(".rules tr")) return;
  row.querySelector("details")?.setAttribute("open", "");
  row.scrollIntoView();
}

const sections = [...document.querySelectorAll("h2:has(+ h3[id])")];
if (document.getElementById("rules-of-nuplan")) {
  const place = sections[0].previousElementSibling;
  const table = rulesTable(sections);
  place.after(filterBox(table), table);
  openLinkedRule();
  addEventListener("hashchange", openLinkedRule);
}
