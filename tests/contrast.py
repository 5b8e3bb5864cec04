"""How well the texts of a page can be read."""

LEAST_CONTRAST = 4.5
# texts with less, as an expression in the page
FAINT = """(() => {
  const parse = (text) => {
    const parts = text.match(/[\\d.]+/g).map(Number);
    const unit = text.startsWith("color(") ? 255 : 1;
    return [...parts.slice(0, 3).map((part) => part * unit), parts[3] ?? 1];
  };
  const over = (above, below) =>
    [0, 1, 2].map((i) => above[i] * above[3] + below[i] * (1 - above[3])).concat(1);
  const luminance = (colour) => {
    const linear = colour.slice(0, 3).map((part) => {
      const share = part / 255;
      return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
    });
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
  };
  const found = [];
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const element = texts.currentNode.parentElement, text = texts.currentNode.data.trim();
    const box = element.getBoundingClientRect();
    if (!text || !box.width || element.closest("script, style")) continue;
    if (!element.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
    let ground = [255, 255, 255, 1], opacity = 1;
    const chain = [];
    for (let node = element; node; node = node.parentElement) chain.unshift(getComputedStyle(node));
    for (const style of chain) {
      ground = over(parse(style.backgroundColor), ground);
      opacity *= style.opacity;
    }
    const colour = parse(chain.at(-1).color);
    colour[3] *= opacity;
    const pair = [luminance(over(colour, ground)), luminance(ground)].sort((a, b) => b - a);
    const contrast = (pair[0] + 0.05) / (pair[1] + 0.05);
    if (contrast < LEAST) found.push(`${contrast.toFixed(2)} ${text.slice(0, 40)}`);
  }
  return found;
})()""".replace("LEAST", str(LEAST_CONTRAST))
