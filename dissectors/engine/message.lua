-- A message in the tree: every value with its bytes.

-- Add the node of a list; return it, or its parent where nobody asks for it.
local function show_count(node, counter, range, name, count, visible)
	if not (visible or counter.on) then return node end
	local list = add(node, counter.field, range, count)
	if visible then set_text(list, format("%s: %d items", name, count)) end
	return list
end

local function show_numbers(node, leaf, counter, tvb, p, count, big, name, visible)
	local range = cut(tvb, p - 1, count * leaf.size)
	if leaf.code == "B" then
		if visible or leaf.record.on then add(node, leaf.field, range) end
		return
	end
	node = show_count(node, counter, range, name, count, visible)
	if not (visible or leaf.record.on) then return end
	local put, size = big and add or add_le, leaf.size
	for index = 0, count - 1 do
		put(node, leaf.field, cut(tvb, p + index * size - 1, size))
	end
end

local show_steps

local function show_list(node, step, tvb, s, p, start, big, visible)
	local from, count = p, step.count
	if not count then count, p = count_at(s, p, start, big) end
	if step.element and count > 0 then
		local leaf = step.steps[1].leaves[1]
		p = p + (start - p) % leaf.size
		show_numbers(node, leaf, step.counter, tvb, p, count, big, step.name, visible)
		return p + count * leaf.size
	end
	local stop = visible and check({step}, s, from, start, #s, big) or p
	local list = show_count(node, step.counter, cut(tvb, from - 1, stop - from), step.name, count, visible)
	for index = 0, count - 1 do
		local item = list
		if (visible or step.item.on) and not step.unnamed then
			stop = visible and check(step.steps, s, p, start, #s, big) or p
			item = add(list, step.item.field, cut(tvb, p - 1, stop - p))
			if visible then set_text(item, format("%s[%d]", step.name, index)) end
		end
		p = show_steps(item, step.steps, tvb, s, p, start, big, visible)
	end
	return p
end

-- Add every value of a valid message; return where it ends.
function show_steps(node, steps, tvb, s, p, start, big, visible)
	for index = 1, #steps do
		local step = steps[index]
		if step.leaves then
			p = p + (start - p) % step.alignment
			local leaves, put = step.leaves, big and add or add_le
			for place = 1, #leaves do
				local leaf = leaves[place]
				if leaf.count then
					show_numbers(node, leaf, leaf.counter, tvb, p + leaf.offset, leaf.count, big, leaf.name, visible)
				elseif visible or leaf.record.on then
					put(node, leaf.field, cut(tvb, p + leaf.offset - 1, leaf.size))
				end
			end
			p = p + step.size
		elseif step.steps then
			p = show_list(node, step, tvb, s, p, start, big, visible)
		else
			local from, length = p + (start - p) % 4, nil
			length, p = count_at(s, p, start, big)
			if visible or step.record.on then
				local range = cut(tvb, from - 1, 4 + length * step.width)
				add(node, step.record.field, range, text_value(step, s, p, length, big))
			end
			p = p + length * step.width
		end
	end
	return p
end
